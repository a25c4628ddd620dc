"""What an episode's path tells, against hand-made paths and independent distances."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.config.footprint import make_rectangle
from acsar_gym.tools.evaluation.episodes import (
    EpisodeResult,
    footprint_clearance,
    mean_jerk,
    run_episodes,
    total_turning,
)
from acsar_gym.worlds import Region, World

FORWARD = np.array([1.0, 0.0], np.float32)
PERIOD = 0.1


def poses(positions: Any, heading: float = 0.5) -> Any:
    """Poses of a straight drive."""
    along = np.asarray(positions)
    turned = np.full_like(along, heading)
    return np.column_stack([along * math.cos(heading), along * math.sin(heading), turned])


def test_jerk_is_the_third_derivative_of_the_way() -> None:
    times = PERIOD * np.arange(12)
    assert mean_jerk(poses(0.4 * times), PERIOD) == pytest.approx(0.0, abs=1e-9)
    assert mean_jerk(poses(0.4 * times**2), PERIOD) == pytest.approx(0.0, abs=1e-9)
    assert mean_jerk(poses(0.4 * times**3), PERIOD) == pytest.approx(6.0 * 0.4)
    assert math.isnan(mean_jerk(poses([0.0, 0.1, 0.2]), PERIOD))


def test_turning_counts_both_ways_and_across_pi() -> None:
    headings = [[0.0, 0.0, theta] for theta in (3.0, -3.1, 3.0)]
    assert total_turning(np.array(headings)) == pytest.approx(2.0 * (math.tau - 6.1))


def test_the_clearance_of_a_footprint_is_that_of_its_nearest_side_or_corner() -> None:
    world = World(circles=np.array([[2.0, 0.0, 0.5]]), segments=np.array([[-1.0, 1.0, 3.0, 1.0]]))
    outline = make_rectangle(0.6, 0.4)
    straight = footprint_clearance(np.array([(0.0, 0.0, 0.0)]), outline, world)
    assert straight == pytest.approx(0.8)
    slanted = footprint_clearance(np.array([(0.0, 0.0, math.pi / 4.0)]), outline, world)
    assert slanted == pytest.approx(1.0 - 0.5 / math.sqrt(2.0))
    both = np.array([(-9.0, -9.0, 0.0), (0.0, 0.0, math.pi / 4.0), (0.0, 0.0, 0.0)])
    assert footprint_clearance(both, outline, world) == slanted


def test_the_poses_that_are_left_out_are_never_the_nearest() -> None:
    rng = np.random.default_rng(0)
    circles = np.column_stack([rng.uniform(-3.0, 3.0, (20, 2)), rng.uniform(0.05, 0.3, 20)])
    world, outline = World(circles=circles), make_rectangle(0.9, 0.3)
    places = rng.uniform(-3.0, 3.0, (50, 3))
    single = [footprint_clearance(place[None], outline, world) for place in places]
    assert footprint_clearance(places, outline, world) == min(single)


def drive(world: World | None, link: str) -> EpisodeResult:
    options: dict[str, Any] = {} if world is None else {"worlds": world}
    env = gymnasium.make(
        "acsar_gym/PointGoal-v0", link=link, robot=RobotConfig(), max_episode_steps=20, **options
    )
    reset: dict[str, Any] = {"goal": (3.0, 0.0)} if world is None else {}
    found = next(run_episodes(env, lambda _: FORWARD, 1, 0, **reset))
    env.close()
    return found


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_an_episode_tells_clearance_energy_and_jerk(link: str) -> None:
    """The robot drives beside a wall at 0.5 m, which its side passes at half its width less."""
    wall = World(
        segments=np.array([[-1.0, 0.5, 9.0, 0.5]]),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(4.0, 0.0),
    )
    found, width = drive(wall, link), max(y for _, y in RobotConfig().outline)
    assert found.clearance == pytest.approx(0.5 - width, abs=1e-3)
    assert found.energy > 0.0
    assert 0.0 < found.jerk < 10.0


def test_a_collision_has_no_clearance_and_an_open_floor_none_to_tell() -> None:
    ahead = World(
        circles=np.array([[0.6, 0.0, 0.2]]), start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0)
    )
    assert drive(ahead, "planar").clearance == 0.0
    assert math.isnan(drive(None, "planar").clearance)
