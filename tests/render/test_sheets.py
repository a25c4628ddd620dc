"""Sheets of worlds, and pictures in files."""

import io
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from top_view_tools import COURT, FRAME

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.render.canvas import round_length, shorten_text
from acsar_gym.render.top_view import (
    FLOOR_COLOUR,
    GOAL_COLOUR,
    OBSTACLE_COLOUR,
    START_COLOUR,
    TITLE_HEIGHT,
    TopView,
    draw_sheet,
    save_picture,
)
from acsar_gym.worlds import Region, World


@pytest.fixture
def top(config: RobotConfig) -> TopView:
    return TopView(config)


def test_a_sheet_has_a_tile_for_each_world() -> None:
    turned = replace(COURT, start=Region(0.0, 0.0, 0.0, math.pi / 2))
    bare = World(goal=Region(3.0, 1.0), path=np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]]))
    image = draw_sheet([COURT, turned, bare], 2, 200)
    assert image.shape == (400, 400, 3)
    assert (image[200:, 200:] == FLOOR_COLOUR).all(), "the fourth tile is empty"
    tiles = [image[:200, :200], image[:200, 200:], image[200:, :200]]
    inks = [(tile[4 : TITLE_HEIGHT - 4, 8:100].sum(axis=2) < 450).sum() for tile in tiles]
    assert inks[0] == inks[1] > 20
    assert inks[2] == 0, "it has no name"
    assert all((tile == START_COLOUR).all(axis=2).any() for tile in tiles)
    assert all((tile == GOAL_COLOUR).all(axis=2).any() for tile in tiles)
    blue = [np.argwhere((tile == START_COLOUR).all(axis=2)) for tile in tiles]
    assert np.ptp(blue[0], axis=0).argmax() == 1, "x is to the right"
    assert np.ptp(blue[1], axis=0).argmax() == 0, "y is up"
    assert blue[1].mean(axis=0)[0] < blue[0].mean(axis=0)[0] - 2, "it points up"
    walls = np.argwhere((tiles[0] == OBSTACLE_COLOUR).all(axis=2))[:, 0]
    assert walls.min() > TITLE_HEIGHT
    assert abs((walls.min() - TITLE_HEIGHT) - (199 - walls.max())) < 3, (
        "it is centred below the title"
    )
    goal = np.argwhere((tiles[2] == GOAL_COLOUR).all(axis=2)).mean(axis=0)
    start = blue[2].mean(axis=0)
    assert goal[0] < start[0], "the goal is above"
    assert goal[1] > start[1]


@pytest.mark.parametrize(("count", "columns"), [(0, 2), (2, 0), (1, -1)])
def test_sheets_of_nothing(count: int, columns: int) -> None:
    with pytest.raises(ConfigError, match=r"no worlds to draw|must be at least 1"):
        draw_sheet([COURT] * count, columns, 100)
    with pytest.raises(ConfigError, match="size"):
        draw_sheet([COURT], 1, 10)


def test_more_columns_than_worlds_make_one_row() -> None:
    assert draw_sheet([COURT], 1000, 100).shape == (100, 100, 3)


def test_long_names_are_shortened() -> None:
    assert shorten_text("court", 12.0, 100.0) == "court"
    short = shorten_text("a very long name of a world" * 9, 12.0, 100.0)
    assert short.startswith("a very")
    assert short.endswith("…")
    assert len(short) < 30


@pytest.mark.parametrize(
    ("most", "length"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (7.0, 5.0), (0.3, 0.2), (99.0, 50.0)]
)
def test_scale_bars_are_of_round_lengths(most: float, length: float) -> None:
    assert round_length(most) == pytest.approx(length)


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


def test_without_pillow_the_extra_is_named(
    config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match=r"acsar_gym\[pictures\]"):
        TopView(config)
    with pytest.raises(MissingExtraError, match=r"acsar_gym\[pictures\]"):
        draw_sheet([COURT], 1, 100)
