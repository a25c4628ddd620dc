"""Rates, path lengths and intervals, against hand-made and independent figures, and tables."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig, RobotEnv, State
from acsar_gym.config.footprint import make_rectangle
from acsar_gym.links.lateness import EpisodeTiming, TickTiming
from acsar_gym.tasks import PointGoal
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.evaluation.episode import Episode, footprint_clearance, mean_jerk
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import (
    bootstrap_interval,
    summarise_episodes,
    wilson_interval,
)
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk

FORWARD = np.array([1.0, 0.0], np.float32)
STAND = np.zeros(2, np.float32)
HALF_WIDTH = max(y for _, y in RobotConfig().outline)


def result(**changes: Any) -> Episode:
    """A success on a path of 5 m instead of 4 m."""
    values: dict[str, Any] = {"success": True, "collision": False, "started": 10.0, "ended": 20.0}
    values |= {"path": 5.0, "driven": 5.0, "shortest": 4.0, "left": 0.0, "odometry_error": 0.05}
    values |= {"turning": 2.5, "episode_return": 4.0, "length": 60, "ticks": 1000}
    return Episode(**values | changes)


@pytest.mark.parametrize(
    ("changes", "spl", "soft_spl"),
    [
        ({}, 0.8, 0.8),
        ({"driven": 3.9}, 1.0, 1.0),  # the tolerance makes ways a little shorter
        ({"success": False, "left": 3.0, "driven": 1.0}, 0.0, 0.25),
        ({"shortest": math.nan}, math.nan, math.nan),
    ],
)
def test_spl_and_soft_spl(changes: dict[str, Any], spl: float, soft_spl: float) -> None:
    episode = result(**changes)
    expected = pytest.approx((spl, soft_spl), nan_ok=True)
    assert (episode.spl, episode.soft_spl) == expected


def test_summarise_episodes_weighs_intrusions_by_duration() -> None:
    episodes = [result(intrusions=1.0, ended=end) for end in (11.0, 69.0)]  # 1 s and 59 s
    summary = summarise_episodes([*episodes, result()])
    assert summary.intrusion_rate == pytest.approx(2.0)
    assert summary.intervals["intrusion_rate"] == pytest.approx((60.0 / 59.0, 60.0))
    assert math.isnan(summarise_episodes([result()]).intrusion_rate)


def test_summarise_episodes_averages_what_is_known() -> None:
    lost = {"success": False, "left": 4.0, "path": 0.0, "driven": 0.0, "episode_return": 1.0}
    kinds: list[dict[str, Any]] = [{}, {"path": 6.0}, {**lost, "length": 30}]
    summary = summarise_episodes([result(**k, told={"laps": n}) for n, k in enumerate(kinds)])
    assert (summary.path, summary.time_to_goal) == pytest.approx((5.5, 10.0))
    assert (summary.episode_return, summary.length, summary.ticks) == pytest.approx((3, 50, 3000))
    assert summary.odometry_drift == pytest.approx(0.05 / 1e-9 / 3.0, rel=1e-3)
    assert (summary.success_rate, summary.timeout_rate) == pytest.approx((2 / 3, 1 / 3))
    assert summary.told == {"laps": 1.0}
    assert summary.intervals["success_rate"] == wilson_interval(2, 3)
    assert summary.intervals["told.laps"] == bootstrap_interval([0.0, 1.0, 2.0])

    row = json.loads(json.dumps(summary.as_row(), allow_nan=False))
    assert (row["cross_track"], row["intervals"]["cross_track"]) == (None, [None, None])
    assert row["told.laps"] == 1.0
    assert math.isnan(summarise_episodes([]).success_rate)


def test_intervals() -> None:
    """Wilson's is a published example, the bootstrap's that of a normal distribution."""
    assert wilson_interval(45, 50) == pytest.approx((0.786, 0.957), abs=1e-3)
    values = np.random.default_rng(0).normal(3.0, 1.0, 200)
    low, high = bootstrap_interval(values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(4.0 / math.sqrt(200), rel=0.15)  # 2 * 1.96 sigma


def test_make_table_keeps_a_long_title_in_one_line() -> None:
    console = report.SafeConsole(width=200)
    with console.capture() as shown:
        console.print(report.make_table("a title of several words", [{"a": "1"}]))
    assert shown.get().startswith("a title of several words\n")


def test_summarise_episodes_joins_round_trips() -> None:
    """The percentiles are those of all trips."""
    nan = math.nan
    nothing = TickTiming(ticks=0, late_ticks=0, missed_ticks=0, p50=nan, p99=nan, worst=nan)
    trips = [(0.04,), (), (*[0.05] * 17, 0.06, 0.08, 0.2)]
    timings = [EpisodeTiming(nothing, nan, times) for times in trips]
    summary = summarise_episodes([result(timing=timing) for timing in timings])
    assert (summary.round_trip, summary.round_trips) == (0.05, 21)
    assert report.count_cells(summary)["round trip"] == "50 ms, 95 % 80 ms, of 21"
    assert "round trip" not in report.count_cells(summarise_episodes([result()]))


def test_summary_table_has_a_line_for_each_known_figure() -> None:
    rows = [(name, summarise_episodes([result()] * n)) for name, n in (("a", 3), ("b", 1))]
    table = report.summary_table("", rows, ["A note."])
    figures, first, second = (list(column.cells) for column in table.columns)
    assert (first[0], second[0]) == ("3/3 (100.0%)", "1/1 (100.0%)")
    place = figures.index("success [%]")
    assert (first[place], second[place]) == ("100.0 (43.9 to 100.0)", "100.0 (20.7 to 100.0)")
    assert {"SPL", "struck [%]"} < {*figures}
    assert "ran into people [%]" not in figures
    assert table.caption == "A note."

    # Odometry that is off by 20 cm.
    doubtful = summarise_episodes([result(odometry_error=0.2)])
    assert "off by 0.20 m" in str(report.summary_table("", [("a", doubtful)]).caption)


def test_write_evaluation_page(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    episodes = [result(seed=0), result(seed=1), result(seed=2, valid=False)]
    path = tmp_path / "page.html"
    summary = summarise_episodes(episodes)
    report.write_evaluation_page(path, "episodes", "/dev/ttyUSB0", summary, episodes)
    html = path.read_text(encoding="utf-8")
    assert "<th>/dev/ttyUSB0</th>" in html
    assert "<td>invalid</td><td>1</td>" in html
    assert "<td>success [%]</td><td>100.0 (43.9 to 100.0)</td>" in html


def drive(env: Any, action: Any, **options: Any) -> Episode:
    """An episode with the same action at every step."""
    (episode,) = run_episodes(env, lambda _: action, 1, seed=0, **options)
    env.close()
    return episode


def among(*movers: Any, **obstacles: Any) -> World:
    start = Region(0.0, 0.0, 0.0, 0.0)
    return World(start=start, goal=Region(4.0, 0.0), movers=movers, **obstacles)


@pytest.mark.parametrize(
    ("world", "action", "link", "wanted"),
    [
        (  # a crash
            among(circles=np.array([[1.0, 0.0, 0.2]])),
            FORWARD,
            "bullet",
            {
                "collision": True,
                "shortest": pytest.approx(4.11, abs=0.09),  # round the pillar
                "left": pytest.approx(3.65, abs=0.25),
                "clearance": 0.0,
            },
        ),
        (
            among(segments=np.array([[-1.0, 0.5, 9.0, 0.5]])),
            FORWARD,
            "bullet",
            {
                "success": True,
                "clearance": pytest.approx(0.5 - HALF_WIDTH, abs=1e-3),
                "energy": pytest.approx(0.512, rel=0.1),
                "jerk": pytest.approx(5.0, abs=5.0),
            },
        ),
        (  # the robot runs into a person
            among(walk([[1.0, 0.0]])),
            FORWARD,
            "planar",
            {"collision_rate": 1.0, "person_collision_rate": 1.0, "closest_person": 0.0},
        ),
        (  # a person runs into the robot
            among(walk([[2.0, 0.0], [-2.0, 0.0]], 1.0)),
            STAND,
            "planar",
            {"collision_rate": 0.0, "person_collision_rate": 0.0, "struck_rate": 1.0},
        ),
        (  # twice within the personal space of one, another stays away
            among(walk([[-2.0, 0.8], [2.0, 0.8]], 1.0, radius=0.25), walk([[0.0, -3.0]])),
            STAND,
            "planar",
            {
                "person_contact": 0.0,
                "closest_person": pytest.approx(0.8 - HALF_WIDTH - 0.25, abs=1e-3),
                "intrusion_rate": pytest.approx(15.0),
                "time_to_collision": 10.0,  # nobody aims at the robot
            },
        ),
    ],
)
def test_measure_episode_in_a_world(
    world: World, action: Any, link: str, wanted: dict[str, Any]
) -> None:
    steps = 80 if action is STAND else 200
    env = gymnasium.make(
        "acsar_gym/ObstacleGoal-v1", link=link, worlds=world, max_episode_steps=steps
    )
    episode = drive(env, action)
    measured = vars(summarise_episodes([episode])) | dataclasses.asdict(episode)
    assert {name: measured[name] for name in wanted} == wanted


class Detour(PointGoal):
    """A task with a shortest path of its own."""

    way: ClassVar[Any] = None

    def shortest_path(self, state: State, memory: Any) -> Any:
        return self.way


@pytest.mark.parametrize(
    ("way", "length"),
    [(1.8, 1.8), (None, math.nan), (np.array([[3.0, 0.0], [0.0, 0.0]]), 6.0)],
)
def test_measure_episode_with_the_tasks_own_way(way: Any, length: float) -> None:
    task = type("Other", (Detour,), {"way": way})()
    episode = drive(gymnasium.wrappers.TimeLimit(RobotEnv(task, link="planar"), 20), FORWARD)
    assert episode.shortest == pytest.approx(length, nan_ok=True)
    if isinstance(way, np.ndarray):
        assert episode.left == pytest.approx(6.0 - episode.driven, abs=0.01)


def test_measure_episode_of_a_path() -> None:
    env = gymnasium.make("acsar_gym/PathFollow-v0", link="planar")
    episode = drive(env, FORWARD, path=[(0.0, 0.1), (1.0, 0.1)])
    assert episode.success
    assert episode.cross_track == pytest.approx(0.1, abs=0.01)
    assert math.isnan(episode.shortest)
    assert math.isnan(episode.clearance)


def test_mean_jerk_is_the_third_derivative_of_the_way() -> None:
    times = 0.1 * np.arange(12)
    for power, jerk in ((1, 0.0), (2, 0.0), (3, 6.0 * 0.4)):
        way = 0.4 * times**power
        poses = np.column_stack([way * math.cos(0.5), way * math.sin(0.5), 0.0 * way + 0.5])
        assert mean_jerk(poses, 0.1) == pytest.approx(jerk, abs=1e-9)
    assert math.isnan(mean_jerk(poses[:3], 0.1))


@pytest.mark.parametrize(("theta", "ahead", "aside"), [(0.0, 0.5, 0.3), (math.pi / 2.0, 0.2, 0.6)])
def test_footprint_clearance_of_the_nearest_corner(
    theta: float, ahead: float, aside: float
) -> None:
    """A pillar of 0.1 m is `ahead` and `aside` of the corner of a box of 0.6 m x 0.4 m."""
    world = World(circles=np.array([[0.8, 0.5, 0.1]]))
    places = np.array([(-9.0, -9.0, 0.0), (0.0, 0.0, theta)])
    clearance = footprint_clearance(places, make_rectangle(0.6, 0.4), world)
    assert clearance == pytest.approx(math.hypot(ahead, aside) - 0.1)


def test_measure_episode_of_a_spin() -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", max_episode_steps=60)
    episode = drive(env, np.array([0.0, -1.0], np.float32))
    assert episode.turning > math.tau
    assert episode.driven < 0.05
    assert episode.pose[2] == pytest.approx(math.remainder(-episode.turning, math.tau), abs=1e-6)
