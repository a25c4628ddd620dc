from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mover_tools import HALL
from PIL import Image as Pillow
from top_view_tools import COURT, FRAME

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
    save_picture,
    trace_way,
)
from acsar_gym.worlds import Pose
from acsar_gym.worlds.movers import Mover, follow_keys, walk


def colour(image: RgbImage, view: View, x: float, y: float) -> tuple[int, ...]:
    """The colour of the picture at a place [m]."""
    column, row = view.pixels(np.array([[x, y]]))[0].astype(int)
    return tuple(image[row, column].tolist())


def near(image: RgbImage, view: View, place: tuple[float, float], wanted: tuple[int, ...]) -> bool:
    """Whether a pixel at a place, or next to it, has a colour; thin lines are blurred."""
    column, row = view.pixels(np.array([place]))[0].astype(int)
    patch = image[row - 1 : row + 2, column - 1 : column + 2].astype(int)
    return bool((np.abs(patch - wanted[:3]).sum(axis=2) < 60).any())


def placed(pose: Pose, x: float, y: float) -> tuple[float, float]:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y


@pytest.fixture
def top(config: RobotConfig) -> TopView:
    return TopView(config)


def test_what_is_where(top: TopView) -> None:
    image = top.draw(FRAME)
    assert image.shape == (480, 480, 3)
    assert image.dtype == np.uint8
    for x, y in ((2.0, 1.0), (3.25, -1.5), (3.6, -1.5), (2.5, 2.5), (2.5, -2.5)):
        assert colour(image, top.view, x, y) == OBSTACLE_COLOUR
    for x, y in ((2.2, 1.4), (2.4, -1.6), (3.25, 1.6)):
        assert colour(image, top.view, x, y) == FLOOR_COLOUR
    assert colour(image, top.view, 4.0, 0.25) == GOAL_COLOUR
    assert colour(image, top.view, 0.0, 0.0) == CHASSIS_COLOUR
    assert near(image, top.view, (4.25, 0.25), GOAL_COLOUR)


def test_ahead_is_up_and_a_map_has_x_to_the_right(config: RobotConfig, top: TopView) -> None:
    of_map = TopView(config, (400, 300), "y")
    places = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    on_a_floor = replace(FRAME, world=None)
    for view, frame, ahead, left in (
        (top, on_a_floor, (0, -1), (-1, 0)),
        (top, FRAME, (1, 0), (0, -1)),
        (of_map, FRAME, (1, 0), (0, -1)),
    ):
        image = view.draw(frame)
        origin, *others = view.view.pixels(places)
        steps = [((other - origin) / view.view.scale).round(6).tolist() for other in others]
        assert steps == [[*ahead], [*left]]
        assert (colour(image, view.view, 2.0, 1.0) == OBSTACLE_COLOUR) == (frame is FRAME)
        assert colour(image, view.view, 4.0, 0.25) == GOAL_COLOUR


def test_odometry_is_seen_only_where_it_differs(config: RobotConfig, top: TopView) -> None:
    pose = (1.0, 0.0, 0.4)
    alone = top.draw(replace(FRAME, odom=pose))
    assert top.draw(replace(FRAME, odom=pose, truth=pose)).tobytes() == alone.tobytes()
    barely = (1.0 + 0.5 / top.view.scale, 0.0, 0.4)
    assert top.draw(replace(FRAME, odom=barely, truth=pose)).tobytes() == alone.tobytes()
    odom = (1.5, 0.5, 0.9)
    image = top.draw(replace(FRAME, odom=odom, truth=pose))
    assert colour(image, top.view, 1.0, 0.0) == CHASSIS_COLOUR
    length, width = config.body.length / 2.0, config.body.width / 2.0
    for x, y in ((length, 0.0), (-length, 0.0), (0.0, width), (0.0, -width), (length / 2.0, 0.0)):
        assert near(image, top.view, placed(odom, x, y), ODOM_COLOUR)
        assert not near(alone, top.view, placed(odom, x, y), ODOM_COLOUR)
    turned = top.draw(replace(FRAME, odom=(1.0, 0.0, 1.2), truth=pose))
    assert turned.tobytes() != alone.tobytes()


def test_rays_light_the_floor_and_end_in_dots(config: RobotConfig, top: TopView) -> None:
    pose, offset = (1.3, 0.0, math.pi / 2), config.lidar_x_offset
    angles = np.array([-0.6, -0.2, 0.2, 0.6])
    ranges = np.array([2.0, 1.5, 1.5, 2.0])
    frame = replace(FRAME, world=None, goal=(3.0, 0.0), odom=pose, rays=(angles, ranges), reach=2.0)
    image = top.draw(frame)

    def at(angle: float, away: float) -> tuple[float, float]:
        return placed(pose, offset + away * math.cos(angle), away * math.sin(angle))

    assert colour(image, top.view, *at(0.2, 1.5)) == RAY_COLOUR
    assert colour(image, top.view, *at(0.6, 2.0)) != RAY_COLOUR, "it met nothing"
    assert colour(image, top.view, *at(0.0, 1.0)) == SEEN_COLOURS[0]
    for angle, away in ((0.0, 1.7), (0.9, 1.0), (math.pi, 0.5)):
        assert colour(image, top.view, *at(angle, away)) == FLOOR_COLOUR


def test_movers_are_discs_with_a_line_ahead(top: TopView) -> None:
    movers = np.array([[1.0, -1.0, 1.0, 0.0, 0.3], [3.0, 1.2, 0.0, 0.0, 0.25]])
    image = top.draw(replace(FRAME, movers=movers))
    for place in ((1.0, -0.7), (1.0, -1.3), (0.7, -1.0), (1.5, -1.0), (3.25, 1.2), (3.0, 0.95)):
        assert near(image, top.view, place, MOVER_COLOUR)
    for x, y in ((0.85, -1.15), (3.0, 1.2)):
        fill = colour(image, top.view, x, y)
        assert fill not in (MOVER_COLOUR, FLOOR_COLOUR)
    for place in ((1.8, -1.0), (0.5, -1.0), (3.4, 1.2)):
        assert not near(image, top.view, place, MOVER_COLOUR)


def test_the_view_shows_where_movers_go(top: TopView) -> None:
    far = replace(COURT, movers=(walk([[2.0, 0.0], [2.0, 4.0]], radius=0.5),))
    top.draw(replace(FRAME, world=far))
    assert top.view.shows(2.0, 4.5, 0.0)
    assert not top.view.shows(2.0, 6.0, 0.0)


@pytest.mark.parametrize("mover", HALL.movers)
def test_a_trace_is_where_a_motion_leads(mover: Mover) -> None:
    way = trace_way(mover)
    for time in np.linspace(0.0, mover.duration, 40):
        place = mover.position(float(time))
        assert np.hypot(*(way - place).T).min() < mover.top_speed * mover.duration / 8.0 + 1e-9
    assert way[0].tolist() == list(mover.position(0.0))
    curve = follow_keys([0.0, 1.0, 3.0], [[0, 0], [2, 1], [0, 2]], smooth=True)
    np.testing.assert_allclose(trace_way(curve)[4], curve.position(0.5))
    np.testing.assert_allclose(trace_way(curve)[13], curve.position(2.0))


@pytest.mark.parametrize("size", [(480,), (63, 480), (480, 5000), (480.5, 480), 480, "ab", None])
def test_sizes_that_cannot_be(config: RobotConfig, size: object) -> None:
    with pytest.raises(ConfigError, match=r"size = .*64 to 4096 pixels"):
        TopView(config, size)  # type: ignore[arg-type]


def test_pictures_are_saved_as_png(tmp_path: Path, top: TopView) -> None:
    image = top.draw(FRAME)
    for name in ("a.png", "B.PNG"):
        save_picture(image, tmp_path / name)
        file = io.BytesIO((tmp_path / name).read_bytes())
        with Pillow.open(file) as read:
            assert read.format == "PNG"
            assert np.array_equal(np.asarray(read), image)


@pytest.mark.parametrize(
    ("name", "message"),
    [("a.jpg", "PNG"), ("a", "PNG"), ("none/a.png", "No such file"), (".png", "PNG")],
)
def test_pictures_that_cannot_be_saved(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: .*{message}") as caught:
        save_picture(np.zeros((2, 2, 3), np.uint8), tmp_path / name)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / name).exists()
