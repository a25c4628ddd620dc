"""What is where in pictures from above."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.render.canvas import View
from acsar_gym.render.top_view import (
    CHASSIS_COLOUR,
    FLOOR_COLOUR,
    GOAL_COLOUR,
    MOVER_COLOUR,
    OBSTACLE_COLOUR,
    ODOM_COLOUR,
    RAY_COLOUR,
    SEEN_COLOURS,
    RgbImage,
    TopView,
    TopViewFrame,
    place_points,
    save_picture,
    thin_path,
)
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk

COURT = World(
    circles=np.array([[2.0, 1.0, 0.25], [3.25, -1.5, 0.5]]),
    segments=np.array([[-1.0, -2.5, 5.0, -2.5], [-1.0, 2.5, 5.0, 2.5]]),
    start=Region(0.0, 0.0, 0.0, 0.0),
    goal=Region(4.0, 0.25, 0.25),
    name="court",
)
FRAME = TopViewFrame(world=COURT, goal=(4.0, 0.25), goal_radius=0.25)


Point = tuple[float, float]


def patch(image: RgbImage, view: View, place: Point, reach: int = 0) -> Any:
    """The colours of the pixels at most `reach` from a place [m]."""
    column, row = view.pixels(np.array([place]))[0].astype(int)
    return image[row - reach : row + reach + 1, column - reach : column + reach + 1].astype(int)


def colour(image: RgbImage, view: View, place: Point) -> tuple[int, ...]:
    """The colour of the picture at a place [m]."""
    return tuple(patch(image, view, place)[0, 0].tolist())


def near(image: RgbImage, view: View, place: Point, wanted: tuple[int, ...]) -> bool:
    """Whether a pixel at a place, or next to it, has a colour. Thin lines are blurred."""
    return bool((np.abs(patch(image, view, place, 1) - wanted).sum(axis=2) < 60).any())


@pytest.fixture
def top(config: RobotConfig) -> TopView:
    return TopView(config)


def test_what_is_where(top: TopView) -> None:
    image = top.draw(FRAME)
    assert image.shape == (480, 480, 3)
    for place in ((2.0, 1.0), (3.25, -1.5), (2.5, 2.5), (2.5, -2.5)):
        assert colour(image, top.view, place) == OBSTACLE_COLOUR
    for place in ((2.2, 1.4), (2.4, -1.6), (3.25, 1.6)):
        assert colour(image, top.view, place) == FLOOR_COLOUR
    assert colour(image, top.view, (4.0, 0.25)) == GOAL_COLOUR
    assert colour(image, top.view, (0.0, 0.0)) == CHASSIS_COLOUR


def test_ahead_is_up_and_a_map_has_x_to_the_right(top: TopView) -> None:
    places = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    for world, directions in ((None, [[0, -1], [-1, 0]]), (COURT, [[1, 0], [0, -1]])):
        image = top.draw(replace(FRAME, world=world))
        origin, *ends = top.view.pixels(places) / top.view.scale
        assert np.subtract(ends, origin).round(6).tolist() == directions
        assert colour(image, top.view, (4.0, 0.25)) == GOAL_COLOUR


def test_odometry_is_seen_only_where_it_differs(config: RobotConfig, top: TopView) -> None:
    pose = (1.0, 0.0, 0.4)
    alone = top.draw(replace(FRAME, odom=pose))
    barely = (1.0 + 0.5 / top.view.scale, 0.0, 0.4)
    assert top.draw(replace(FRAME, odom=barely, truth=pose)).tobytes() == alone.tobytes()
    odom = (1.5, 0.5, 0.9)
    image = top.draw(replace(FRAME, odom=odom, truth=pose))
    ends = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    edges = ends * (config.body.length / 2.0, config.body.width / 2.0)
    for x, y in place_points(edges, odom):
        assert near(image, top.view, (x, y), ODOM_COLOUR)
        assert not near(alone, top.view, (x, y), ODOM_COLOUR)


def test_rays_light_the_floor_and_end_in_dots(config: RobotConfig, top: TopView) -> None:
    angles = np.array([-0.6, -0.2, 0.2, 0.6])
    ranges = np.array([2.0, 1.5, 1.5, 2.0])
    pose = (1.3, 0.0, math.pi / 2)
    frame = replace(FRAME, world=None, goal=(3.0, 0.0), odom=pose)
    image = top.draw(replace(frame, rays=(angles, ranges), reach=2.0))

    def seen_at(angle: float, distance: float) -> tuple[int, ...]:
        x = config.lidar_x_offset + distance * math.cos(angle)
        place = place_points(np.array([[x, distance * math.sin(angle)]]), pose)[0]
        return colour(image, top.view, (place[0], place[1]))

    assert seen_at(0.2, 1.5) == RAY_COLOUR
    assert seen_at(0.6, 2.0) != RAY_COLOUR, "it met nothing"
    assert seen_at(0.0, 1.0) == SEEN_COLOURS[0]
    assert seen_at(0.0, 1.7) == seen_at(math.pi, 0.5) == FLOOR_COLOUR


def test_thin_path_keeps_the_end_of_a_long_drive() -> None:
    path = [(float(x), 0.0) for x in range(100_000)]
    thinned = thin_path(path)
    assert len(thinned) < 1002
    assert thinned[[0, -1], 0].tolist() == [0.0, 99_999.0]
    assert thin_path(path[:3]).tolist() == [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]
    assert thin_path([]).shape == (0, 2)


def test_movers_are_discs_with_a_line_ahead(top: TopView) -> None:
    image = top.draw(replace(FRAME, movers=np.array([[1.0, -1.0, 1.0, 0.0, 0.3]])))
    for place in ((1.0, -0.7), (1.0, -1.3), (0.7, -1.0), (1.5, -1.0)):
        assert near(image, top.view, place, MOVER_COLOUR)
    assert colour(image, top.view, (0.85, -1.15)) not in (MOVER_COLOUR, FLOOR_COLOUR)
    assert not near(image, top.view, (1.8, -1.0), MOVER_COLOUR)


def test_the_view_shows_where_movers_go_and_where_the_robot_is(top: TopView) -> None:
    top.draw(replace(FRAME, world=replace(COURT, movers=(walk([[2.0, 0.0], [2.0, 4.0]]),))))
    assert top.view.shows(2.0, 4.0, 0.0)
    assert not top.view.shows(9.0, 6.0, 0.0)
    top.draw(replace(FRAME, odom=(9.0, 6.0, 0.0)))
    assert top.view.shows(9.0, 6.0, 0.0)


@pytest.mark.parametrize("size", [(480,), (63, 480), (480.5, 480)])
def test_sizes_that_cannot_be(config: RobotConfig, size: object) -> None:
    with pytest.raises(ConfigError, match=r"size = .*64 to 4096 pixels"):
        TopView(config, size)  # type: ignore[arg-type]


def test_pictures_are_saved_as_png(tmp_path: Path, top: TopView) -> None:
    image = top.draw(FRAME)
    save_picture(image, tmp_path / "B.PNG")
    assert np.array_equal(np.asarray(Pillow.open(tmp_path / "B.PNG")), image)
    for name, message in (("a.jpg", "PNG"), ("none/a.png", "No such file")):
        with pytest.raises(ConfigError, match=f"{name}: .*{message}"):
            save_picture(image, tmp_path / name)
