"""Rates, path lengths and intervals, against hand-made and independent figures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

from acsar_gym import Outcome, RobotConfig, RobotEnv, State, Task
from acsar_gym.config.footprint import make_rectangle
from acsar_gym.links.lateness import EpisodeTiming, TickTiming
from acsar_gym.tasks import Observation
from acsar_gym.tools.evaluation.episode import (
    Episode,
    footprint_clearance,
    mean_jerk,
)
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import (
    bootstrap_interval,
    summarise_episodes,
    wilson_interval,
)
from acsar_gym.tools.evaluation.report import count_cells
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import Mover, walk

FORWARD, STAND = np.array([1.0, 0.0], np.float32), np.zeros(2, np.float32)


def result(**known: Any) -> Episode:
    values: dict[str, Any] = {"success": True, "collision": False, "started": 10.0, "ended": 20.0}
    values |= {"path": 5.0, "driven": 5.0, "shortest": 4.0, "left": 0.0, "odometry_error": 0.05}
    values |= {"turning": 2.5, "episode_return": 4.0, "length": 60, "ticks": 1000}
    return Episode(**values | known)


LOST = {"success": False, "left": 4.0, "path": 0.0, "driven": 0.0}
LOST |= {"episode_return": 1.0, "length": 30}
CRASH = {"success": False, "collision": True, "left": 3.0, "driven": 1.0, "path": 1.0}


def test_spl_of_hand_made_episodes() -> None:
    assert result().spl == pytest.approx(0.8)
    assert result(driven=3.9).spl == 1.0  # the tolerance makes ways a little shorter
    assert result(**CRASH).spl == 0.0
    assert math.isnan(result(shortest=math.nan).spl)


def test_soft_spl_weighs_progress() -> None:
    assert result(**CRASH).soft_spl == pytest.approx(0.25)
    assert result(left=2.0, driven=8.0).soft_spl == pytest.approx(0.25)
    assert result(left=6.0).soft_spl == 0.0
    assert result(left=math.inf).soft_spl == 0.0


def test_wilson_is_the_published_example() -> None:
    """45 of 50 is 0.79 to 0.96."""
    assert wilson_interval(45, 50) == pytest.approx((0.786, 0.957), abs=1e-3)
    assert wilson_interval(0, 10)[0] == 0.0
    assert wilson_interval(10, 10)[1] == 1.0


def test_a_rate_weighs_episodes_by_their_duration() -> None:
    short = result(intrusions=1.0, ended=11.0)  # 1 s
    summary = summarise_episodes([short, result(intrusions=1.0, ended=69.0), result()])
    assert summary.intrusion_rate == pytest.approx(2.0)
    low, high = summary.intervals["intrusion_rate"]
    assert low == pytest.approx(60.0 / 59.0)
    assert high == pytest.approx(60.0)
    assert math.isnan(summarise_episodes([result()]).intrusion_rate)


def test_means_have_intervals_and_json_is_clean() -> None:
    summary = summarise_episodes([result(), result(path=6.0, cross_track=math.nan), result(**LOST)])
    assert summary.path == pytest.approx(5.5)
    assert summary.time_to_goal == pytest.approx(10.0)
    assert (summary.episode_return, summary.length) == pytest.approx((3.0, 50.0))
    assert summary.odometry_drift == pytest.approx(0.05 / 1e-9 / 3.0, rel=1e-3)
    assert summary.ticks == 3000
    data = json.loads(json.dumps(summary.as_row(), allow_nan=False))
    assert data["cross_track"] is None
    assert summarise_episodes([result(**LOST)]).as_row()["time_to_goal"] is None
    assert math.isnan(summarise_episodes([]).success_rate)
    low, high = data["intervals"]["success_rate"]
    assert low < 2.0 / 3.0 < high
    values = np.random.default_rng(0).normal(3.0, 1.0, 200).tolist()
    low, high = bootstrap_interval(values)
    assert low < np.mean(values) < high
    assert high - low == pytest.approx(4.0 / math.sqrt(200), rel=0.15)  # 2 * 1.96 sigma


def test_round_trips_are_a_distribution() -> None:
    nothing = TickTiming(0, 0, 0, math.nan, math.nan, math.nan)
    timings = [
        EpisodeTiming(nothing, math.nan, trips)
        for trips in ((0.04,), (), (*[0.05] * 17, 0.06, 0.08, 0.2))
    ]
    found = summarise_episodes([result(timing=timing) for timing in timings])
    assert (found.round_trip, found.round_trips) == (0.05, 21)
    assert found.round_trip_p95 == pytest.approx(0.08)  # of all trips, not of the longest
    assert count_cells(found)["round trip"] == "50 ms, 95 % 80 ms, of 21"
    assert "round trip" not in count_cells(summarise_episodes([result()]))


def drive(world: World, action: Any = FORWARD, link: str = "planar", steps: int = 200) -> Episode:
    env_id = "acsar_gym/ObstacleGoal-v1"
    env = gymnasium.make(env_id, link=link, worlds=world, max_episode_steps=steps)
    (episode,) = run_episodes(env, lambda _: action, 1, seed=0)
    env.close()
    return episode


def ahead(*circles: tuple[float, float, float]) -> World:
    return World(np.array(circles).reshape(-1, 3), start=Region(0, 0, 0, 0), goal=Region(2.0, 0.0))


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_a_crash_is_a_collision_with_its_progress(link: str) -> None:
    episode = drive(ahead((1.0, 0.0, 0.2)), link=link)
    assert (episode.success, episode.collision) == (False, True)
    assert episode.shortest > 2.05  # round the pillar
    assert 1.4 < episode.left < 1.9
    assert 0.15 < episode.soft_spl < 0.4
    assert episode.clearance == 0.0


def among(*movers: Mover) -> World:
    return World(start=Region(0, 0, 0, 0), goal=Region(4.0, 0.0), movers=movers)


def test_running_into_somebody_is_a_collision() -> None:
    episode = drive(among(walk([[1.0, 0.0]])))
    assert (episode.collision, episode.person_contact) == (True, 1.0)
    assert (episode.closest_person, episode.time_to_collision, episode.intrusions) == (0.0, 0.0, 1)
    assert math.isnan(episode.clearance)  # of what stands
    summary = summarise_episodes([episode])
    assert (summary.collision_rate, summary.person_collision_rate) == (1.0, 1.0)
    assert (summary.struck_rate, summary.timeout_rate) == (0.0, 0.0)


def test_somebody_who_runs_into_a_robot_that_stands_is_no_collision_of_its_own() -> None:
    episode = drive(among(walk([[2.0, 0.0], [-2.0, 0.0]], 1.0)), STAND)
    assert (episode.success, episode.collision, episode.person_contact) == (False, False, 2.0)
    assert episode.closest_person == 0.0
    summary = summarise_episodes([episode])
    assert (summary.struck_rate, summary.collision_rate, summary.timeout_rate) == (1.0, 0.0, 0.0)


def test_people_who_pass_are_measured_from_hull_to_hull() -> None:
    """One walks past the robot's side, twice into its personal space; the other stays away."""
    width, radius = max(y for _, y in RobotConfig().outline), 0.25
    passing = walk([[-2.0, 0.8], [2.0, 0.8]], 1.0, radius=radius)
    episode = drive(among(passing, walk([[0.0, -3.0]])), STAND, steps=80)
    assert (episode.collision, episode.person_contact) == (False, 0.0)
    assert episode.closest_person == pytest.approx(0.8 - width - radius, abs=1e-3)
    assert episode.intrusions == 2.0
    assert episode.time_to_collision == 10.0  # it never aims at the robot
    assert summarise_episodes([episode]).intrusion_rate == pytest.approx(15.0)


class Patrol(Task):
    """Touch two posts, then come back: the goal of the env means nothing."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {"x": (-5.0, 5.0)}
    memory: ClassVar[Mapping[str, float]] = {"done": 0.0}
    posts = ((1.0, 0.0), (0.2, 0.0))

    def outcome(self, state: State, memory: Any) -> Outcome:
        post = self.posts[min(int(memory.done), 1)]
        memory.done += math.dist(post, state.pose[:2]) < 0.1
        return Outcome.SUCCESS if memory.done == 2.0 else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return 0.0

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return (state.pose[0] - 5.0 * (memory.done > 0.0),)


class SaidPatrol(Patrol):
    way: ClassVar[Any] = ...

    def shortest_path(self, state: State, memory: Any) -> Any:
        return self.posts[int(memory.done) :] if self.way is ... else self.way


def back_and_forth(observation: Observation) -> Observation:
    return np.array([1.0 if observation[0] > -1.5 else -1.0, 0.0], np.float32)


def patrol(task: Task) -> Episode:
    env = gymnasium.wrappers.TimeLimit(RobotEnv(task, link="planar"), 100)
    (episode,) = run_episodes(env, back_and_forth, 1, seed=0)
    env.close()
    assert episode.success
    return episode


def test_a_task_says_its_shortest_path() -> None:
    episode = patrol(SaidPatrol())
    assert episode.shortest == pytest.approx(1.8)
    assert episode.left == pytest.approx(0.0)
    assert 0.8 < episode.spl <= 1.0
    assert episode.soft_spl == pytest.approx(episode.spl)


@pytest.mark.parametrize(
    ("way", "length"),
    [(1.8, 1.8), ((), 0.0), (None, math.nan), (np.array([[0.0, 2.0]]), 2.0)],
)
def test_a_way_is_places_or_a_length(way: Any, length: float) -> None:
    kind = type("Other", (SaidPatrol,), {"way": way})
    assert patrol(kind()).shortest == pytest.approx(length, nan_ok=True)


def test_paths_are_judged_by_the_distance_beside_them() -> None:
    env = gymnasium.make("acsar_gym/PathFollow-v0", link="planar")
    (episode,) = run_episodes(env, lambda _: FORWARD, 1, seed=0, path=[(0.0, 0.1), (1.0, 0.1)])
    env.close()
    assert episode.success
    assert episode.cross_track == pytest.approx(0.1, abs=0.01)
    assert math.isnan(episode.shortest)
    assert math.isnan(episode.clearance)


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


def test_the_clearance_of_a_footprint_is_that_of_its_nearest_side_or_corner() -> None:
    world = World(circles=np.array([[2.0, 0.0, 0.5]]), segments=np.array([[-1.0, 1.0, 3.0, 1.0]]))
    outline = make_rectangle(0.6, 0.4)
    straight = footprint_clearance(np.array([(0.0, 0.0, 0.0)]), outline, world)
    assert straight == pytest.approx(0.8)
    slanted = footprint_clearance(np.array([(0.0, 0.0, math.pi / 4.0)]), outline, world)
    assert slanted == pytest.approx(1.0 - 0.5 / math.sqrt(2.0))
    both = np.array([(-9.0, -9.0, 0.0), (0.0, 0.0, math.pi / 4.0), (0.0, 0.0, 0.0)])
    assert footprint_clearance(both, outline, world) == slanted


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_an_episode_tells_clearance_energy_and_jerk(link: str) -> None:
    """The robot drives beside a wall at 0.5 m, which its side passes at half its width less."""
    wall = World(
        segments=np.array([[-1.0, 0.5, 9.0, 0.5]]),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(4.0, 0.0),
    )
    found, width = drive(wall, link=link), max(y for _, y in RobotConfig().outline)
    assert found.clearance == pytest.approx(0.5 - width, abs=1e-3)
    assert found.energy > 0.0
    assert 0.0 < found.jerk < 10.0
