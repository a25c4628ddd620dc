"""Draws of a world, and of a start and a goal in its regions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.tasks.episode import Assignment, draw_in_world
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.world import to_world


def draw(source: Any, count: int, *, follow: bool = False, **options: Any) -> list[Assignment]:
    rng = np.random.default_rng(0)
    pool = Pool.of(source)
    return [draw_in_world(pool, rng, options, follow=follow) for _ in range(count)]


def test_draw_in_world_fills_the_regions() -> None:
    wide = World(start=Region(-4.0, 1.0, 0.5), goal=Region(4.0, -1.0, 1.0), name="wide")
    draws = draw(wide, 800)
    starts = np.array([assignment.start for assignment in draws])
    from_middle = np.hypot(starts[:, 0] - wide.start.x, starts[:, 1] - wide.start.y)
    assert 0.45 < from_middle.max() <= 0.5
    assert np.mean(from_middle < 0.5 / math.sqrt(2.0)) == pytest.approx(0.5, abs=0.08)
    assert np.ptp(starts[:, 2]) == pytest.approx(math.tau, rel=0.02)
    assert np.mean(starts[:, 2]) == pytest.approx(0.0, abs=0.2)
    distances = np.hypot(*np.array([assignment.goal for assignment in draws]).T)
    assert distances.min() > math.hypot(8.0, 2.0) - 1.5
    assert distances.max() < math.hypot(8.0, 2.0) + 1.5


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ("open:5", {"world": 5}, "world 5: must be of open 0 to 4"),
        ("open:5", {"world": "4"}, "world = '4': must be a number, among several sets a name"),
        ("open:5", {"goal": (1.0, math.inf)}, "goal"),
    ],
)
def test_draw_in_world_refuses_wrong_options(
    source: Any, options: dict[str, Any], message: str
) -> None:
    with pytest.raises((ConfigError, WorldError), match=message):
        draw(source, 1, **options)


def test_draw_in_world_of_several_sets_is_by_name() -> None:
    sources = ["open:5", "rooms:5"]
    (assignment,) = draw(sources, 1, world="rooms 3")
    assert (assignment.world_key, assignment.info) == ("rooms 3", {})
    kinds = {str(assignment.world_key).partition(" ")[0] for assignment in draw(sources, 20)}
    assert kinds == {"open", "rooms"}


@pytest.mark.parametrize("follow", [False, True])
def test_draw_in_world_returns_the_worlds_of_the_pool(follow: bool) -> None:
    """Nothing has to be built again, and the start is a place in the world."""
    worlds: dict[Any, Any] = {}
    for assignment in draw("clutter:2", 10, follow=follow):
        world: Any = assignment.world
        assert worlds.setdefault(assignment.world_key, world) is world
        place = to_world(assignment.start, (*assignment.goal, 0.0))
        assert place[:2] == pytest.approx((world.goal.x, world.goal.y))
        assert assignment.start[:2] == pytest.approx(world.path[0])


def test_draw_in_world_follows_a_path_from_its_own_start() -> None:
    path = np.array([[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]])
    world = World(start=Region(0.0, 0.0), goal=Region(5.0, 5.0, 0.5), path=path)
    (assignment,) = draw(world, 1, follow=True)
    assert assignment.goal == pytest.approx((1.0, 1.0))
    followed: Any = assignment.path
    assert followed[0] == pytest.approx([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="read-only"):  # a task gets it
        followed[0] = 1.0
