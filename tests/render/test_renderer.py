"""Pictures of an env, and windows."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from mover_tools import HALL

from acsar_gym.errors import ConfigError
from acsar_gym.render.renderer import Window
from acsar_gym.render.top_view import MOVER_COLOUR

HALVES = np.zeros((60, 100, 3), np.uint8)
HALVES[:, :50] = (200, 30, 40)


def _has_display() -> bool:
    if not os.environ.get("DISPLAY"):
        return False
    try:
        import tkinter as tk

        tk.Tk().destroy()
    except (ImportError, RuntimeError):
        return False
    except tk.TclError:
        return False
    return True


needs_display = pytest.mark.skipif(not _has_display(), reason="no display")


def test_what_moves_is_seen_where_it_is_now() -> None:
    """And a window shows the same picture."""
    options: dict[str, Any] = {"link": "planar", "worlds": HALL, "render_mode": "rgb_array"}
    env: Any = gymnasium.make("acsar_gym/ObstacleGoal-v1", **options)
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(2):
        env.step(np.zeros(2, np.float32))
        pictures.append(env.render())
    env.close()
    seen = [(picture == MOVER_COLOUR).all(axis=2) for picture in pictures]
    assert min(places.sum() for places in seen) > 50
    assert all((one != other).any() for one, other in itertools.pairwise(seen))


@pytest.fixture
def window() -> Iterator[Window]:
    window = Window("a title")
    yield window
    window.close()


@pytest.mark.parametrize("display", [None, "", ":999"])
def test_without_a_display_it_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, display: str | None
) -> None:
    pytest.importorskip("tkinter")
    monkeypatch.delenv("DISPLAY", raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    window = Window("a title")
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"needs a display.*rgb_array"):
            window.show(HALVES)
    assert not window.closed
    for _ in range(2):
        window.close()
    window.show(HALVES)
    assert window.closed


@needs_display
def test_it_shows_the_pixels(window: Window) -> None:
    window.show(HALVES)
    root, photo = window._root, window._photo
    assert root is not None
    assert photo is not None
    assert root.title() == "a title"
    assert (root.winfo_width(), root.winfo_height()) == (100, 60)
    assert [photo.get(x, 30) for x in (0, 49, 50, 99)] == [(200, 30, 40)] * 2 + [(0, 0, 0)] * 2
    window.show(np.full((30, 40, 3), 255, np.uint8)[::-1, ::-1])
    assert (root.winfo_width(), root.winfo_height()) == (40, 30)
    assert photo.get(39, 29) == (255, 255, 255)
    del root, photo
