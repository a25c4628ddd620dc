"""ROS maps: exact outlines, their frame, and pictures that mean harm."""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from acsar_gym.errors import MissingExtraError, WorldError
from acsar_gym.worlds import files, maps
from acsar_gym.worlds.world import Region, World

SETTINGS: dict[str, Any] = {"image": "map.pgm", "resolution": 0.5, "origin": [0.0, 0.0, 0.0]}
ENDS = {"start": {"x": 0.0, "y": 0.0, "theta": 0.0}, "goal": {"x": 3.0, "y": 1.0}}
PIXEL = b"P5 1 1 255\n\0"
"""A black pixel."""


def load(folder: Path, data: bytes, **changes: Any) -> World:
    (folder / "map.pgm").write_bytes(data)
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({**SETTINGS, **ENDS, **changes}), encoding="utf-8")
    return files.load_world(path)


def assert_square(world: World, left: float, low: float) -> None:
    """Assert that a world has the sides of a pixel of half a metre, in any order and direction."""
    right = left + 0.5
    high = low + 0.5
    sides = [(left, low, right, low), (left, high, right, high)]
    sides += [(left, low, left, high), (right, low, right, high)]
    rows = np.round(world.segments, 9).tolist()
    assert sorted(min(tuple(row), (*row[2:], *row[:2])) for row in rows) == sorted(sides)


def test_map_pixel_is_a_square_and_the_first_row_is_the_top(tmp_path: Path) -> None:
    world = load(tmp_path, b"P5\n# a test\n3 2\n255\n\xfe\0\xfe\xfe\xcd\xfe")  # 205 is unknown
    assert_square(world, 0.5, 0.5)
    assert (world.start, world.goal) == (Region(0.0, 0.0, 0.0, 0.0), Region(3.0, 1.0))
    assert (world.name, len(world.circles)) == ("map", 0)


def test_map_origin_moves_and_turns_it(tmp_path: Path) -> None:
    assert_square(load(tmp_path, PIXEL, origin=[10.0, -2.0, math.pi / 2.0]), 9.5, -2.0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (8, 2), (7, 8)])
def test_trace_outlines_has_exactly_the_edges_of_pixels(shape: tuple[int, int]) -> None:
    mask = np.random.default_rng(1).random(shape) < 0.5
    edges: list[tuple[int, ...]] = []
    for x1, y1, x2, y2 in maps.trace_outlines(mask).astype(int).tolist():
        dx = int(x2 > x1)
        dy = int(y2 > y1)
        edges += [(x1 + k * dx, y1 + k * dy, dx, dy) for k in range(x2 - x1 + y2 - y1)]
    filled = np.pad(mask[::-1], 1).astype(int)
    expected = {(x - 1, y, 1, 0) for y, x in np.argwhere(np.diff(filled, axis=0))}
    expected |= {(x, y - 1, 0, 1) for y, x in np.argwhere(np.diff(filled, axis=1))}
    assert len(edges) == len(set(edges))  # each edge once
    assert set(edges) == expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [True, True, False, False, False]),
        ({"negate": 1}, [False, False, True, True, True]),
        ({"mode": "raw", "negate": 1}, [False, True, False, False, False]),
    ],
)
def test_occupied_shades_by_mode(changes: dict[str, Any], expected: list[bool]) -> None:
    shades = np.array([0.0, 70.0, 200.0, 254.0, 255.0]) / 255.0
    config = maps.read_settings({**SETTINGS, **changes})
    assert maps.occupied_shades(shades, config).tolist() == expected


def png(pixels: Any, mode: str | None = None) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(stream, "PNG")
    return stream.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        *(png(np.array([[0, 255]], np.uint8), mode) for mode in ("1", "P", "LA")),
        png(np.array([[0, 65535]], np.uint16)),
        png(np.array([[[0, 0, 0, 255], [0, 0, 0, 0]]], np.uint8)),
        *(b"P2 2 1 9 0 9", b"P5 2 1 65535 \0\0\xff\xff"),
    ],
)
def test_map_is_read_of_every_kind_of_picture(data: bytes, tmp_path: Path) -> None:
    """A black pixel next to a white pixel."""
    assert_square(load(tmp_path, data), 0.0, 0.0)


START = "has no start: run 'acsar-gym worlds convert FILE OUT.yaml --start X,Y,THETA' [m, rad]"


@pytest.mark.parametrize(
    ("data", "changes", "message"),
    [
        (PIXEL, {"ocupied_thresh": 0.5}, "unknown key 'ocupied_thresh'; did you mean 'occu"),
        (PIXEL, {"start": None}, START),
        (b"P5 99999999 99999999 255\n", {}, "image 'map.pgm': has more than"),
        (b"P5 2 2 255\n\0", {}, "image 'map.pgm': isn't a sound PGM"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_map_that_is_broken_or_hostile_is_refused(
    data: bytes, changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(WorldError) as caught:
        load(tmp_path, data, **changes)
    text = str(caught.value)
    assert text.startswith(f"{tmp_path / 'map.yaml'}: {message}")
    assert "\n" not in text


def test_map_without_pillow_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match=r"'\.\[pictures\]'"):
        load(tmp_path, PIXEL)
