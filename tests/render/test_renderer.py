"""Pictures of an env, and windows."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from scenes import HALL

from acsar_gym.errors import ConfigError
from acsar_gym.physics.body import has_display
from acsar_gym.render.renderer import Window
from acsar_gym.render.top_view import MOVER_COLOUR

HALVES = np.zeros((60, 100, 3), np.uint8)
HALVES[:, :50] = (200, 30, 40)


def test_render_shows_movers_where_they_are() -> None:
    options: dict[str, Any] = {"link": "planar", "worlds": HALL, "render_mode": "rgb_array"}
    env: Any = gymnasium.make("acsar_gym/ObstacleGoal-v1", **options)
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(2):
        env.step(np.zeros(2, np.float32))
        pictures.append(env.render())
    env.close()
    movers = [(picture == MOVER_COLOUR).all(axis=2) for picture in pictures]
    assert min(places.sum() for places in movers) > 50
    assert all((first != second).any() for first, second in itertools.pairwise(movers))


@pytest.fixture
def window() -> Iterator[Window]:
    window = Window("a title")
    yield window
    window.close()


@pytest.mark.parametrize("display", ["", ":999"])
def test_window_explains_what_to_do_without_a_display(
    monkeypatch: pytest.MonkeyPatch, window: Window, display: str
) -> None:
    pytest.importorskip("tkinter")
    monkeypatch.setenv("DISPLAY", display)
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"needs a display.*rgb_array"):
            window.show(HALVES)
    assert not window.closed
    window.close()
    window.show(HALVES)
    assert window.closed


@pytest.mark.skipif(not has_display(), reason="no display")
def test_window_shows_the_pixels(window: Window) -> None:
    window.show(HALVES)
    assert window._root is not None
    assert window._photo is not None
    assert window._root.title() == "a title"
    assert (window._root.winfo_width(), window._root.winfo_height()) == (100, 60)
    assert [window._photo.get(x, 30) for x in (0, 99)] == [(200, 30, 40), (0, 0, 0)]
    window.show(np.full((30, 40, 3), 255, np.uint8)[::-1, ::-1])
    assert (window._root.winfo_width(), window._root.winfo_height()) == (40, 30)
