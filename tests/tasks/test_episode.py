"""Draws of a world, and of a start and a goal in its regions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.tasks.episode import draw_in_world
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.world import to_world

WIDE = World(start=Region(-4.0, 1.0, 0.5), goal=Region(4.0, -1.0, 1.0), name="wide")


def test_starts_and_goals_fill_their_regions() -> None:
    rng, pool = np.random.default_rng(0), Pool.of(WIDE)
    starts, goals, headings = [], [], []
    for _ in range(400):
        x, y, heading = draw_in_world(pool, rng, {}).start
        headings.append(heading)
        starts.append(math.dist((x, y), (WIDE.start.x, WIDE.start.y)))
        goals.append(draw_in_world(pool, rng, {}).goal)
    assert 0.45 < max(starts) <= 0.5
    assert np.mean(np.array(starts) < 0.5 / math.sqrt(2.0)) == pytest.approx(0.5, abs=0.08)
    counts, _ = np.histogram(np.mod(headings, math.tau), 4, (0.0, math.tau))
    assert counts.min() > 60
    distances = np.hypot(*np.array(goals).T)
    assert distances.min() > math.hypot(8.0, 2.0) - 1.5
    assert distances.max() < math.hypot(8.0, 2.0) + 1.5


@pytest.mark.parametrize(
    ("source", "options", "named"),
    [
        ("open:5", {"world": 5}, "world 5: must be of open 0 to 4"),
        ("open:5", {"world": 2.5}, "world"),
        ("open:5", {"goal": (1.0, math.inf)}, "goal"),
        (["open:5", "rooms:5"], {"world": 2}, "world 2: must be a name like 'clutter 17'"),
    ],
)
def test_what_cannot_be_drawn_is_one_clear_error(
    source: Any, options: dict[str, Any], named: str
) -> None:
    with pytest.raises((ConfigError, WorldError), match=named) as caught:
        draw_in_world(Pool.of(source), np.random.default_rng(0), options)
    assert "\n" not in str(caught.value)


def test_among_several_sets_a_world_is_chosen_and_reported_by_its_name() -> None:
    pool = Pool.of(["open:5", "rooms:5"])
    drawn = draw_in_world(pool, np.random.default_rng(0), {"world": "rooms 3"})
    assert (drawn.world_key, drawn.info) == ("rooms 3", {})
    rng = np.random.default_rng(0)
    kinds = {str(draw_in_world(pool, rng, {}).world_key).partition(" ")[0] for _ in range(20)}
    assert kinds == {"open", "rooms"}


def test_worlds_do_not_move() -> None:
    """Every episode gets the pool's own world, and says where in it the robot starts."""
    rng, pool = np.random.default_rng(0), Pool.of("clutter:2")
    for follow in (False, True):
        for _ in range(5):
            assignment = draw_in_world(pool, rng, {}, follow=follow)
            world = pool[assignment.world_key]
            assert assignment.world is world
            assert world.path is not None
            place = to_world(assignment.start, (*assignment.goal, 0.0))
            assert place[:2] == pytest.approx((world.goal.x, world.goal.y))
            assert assignment.start[:2] == pytest.approx(world.path[0])
    given = World(start=Region(-4.0, 1.0), goal=Region(4.0, -1.0))
    worlds = [draw_in_world(pool, rng, {"world": given}).world for _ in range(2)]
    assert worlds[0] is worlds[1], "nothing has to be built again"


def test_a_path_is_followed_from_its_own_start_to_its_own_end() -> None:
    path = np.array([[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]])
    world = World(start=Region(0.0, 0.0), goal=Region(5.0, 5.0, 0.5), path=path)
    assignment = draw_in_world(Pool.of(world), np.random.default_rng(0), {}, follow=True)
    assert assignment.goal == pytest.approx((1.0, 1.0))
    assert assignment.path is not None
    assert assignment.path[0] == pytest.approx([0.0, 0.0, 0.0])
