"""Comparisons of two sides whose difference is known."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rollout_tools import HIDDEN, rollouts

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Recording
from acsar_gym.tools.sysid.sim_real import (
    EPISODE_METRICS,
    SideComparison,
    compare_sides,
    compare_values,
    comparison_table,
    conclude_comparison,
    difference_sizes,
    distribution_distances,
    paired_rate_interval,
)

ACSAR = RobotConfig.preset("acsar")


@cache
def sim(first: int = 0, last: int = 6) -> Recording:
    return rollouts(ACSAR, range(first, last))


@cache
def real() -> Recording:
    """A slower robot; one seed isn't among those of the simulation."""
    return rollouts(ACSAR.with_(**HIDDEN, max_linear=0.4), range(1, 7))


def sides() -> SideComparison:
    return compare_sides([("sim.mcap", sim())], [("real.mcap", real())])


def test_episodes_are_paired_by_seed() -> None:
    assert [(a.key[0], b.key[0]) for a, b in sides().pairs] == [(n, n) for n in range(1, 6)]
    assert len(sides().notes) == 3  # one without a partner on each side; real.mcap is simulated


def test_repeated_seeds_are_paired_in_their_order() -> None:
    twice = [("a", sim()), ("b", sim())]
    found = compare_sides(twice, [("real.mcap", real())])
    assert len(found.pairs) == 5
    assert len(compare_sides(twice, twice).pairs) == 12
    assert compare_sides(twice, twice).pairs[6][0].name == "seed 0 (2)"


def test_the_slower_robot_is_found() -> None:
    found = sides().comparisons()
    assert found["success_rate"].values == (1.0, 1.0)
    slower = found["time_to_goal"]
    assert slower.differs
    assert slower.difference > 0.3
    assert slower.pairs == 5
    assert any(line.startswith("time to the goal") for line in conclude_comparison(sides()))
    assert difference_sizes(sides())["time_to_goal"] > 0.3


def test_a_side_doesnt_differ_from_itself() -> None:
    same = compare_sides([("a", sim())], [("b", sim())])
    assert not any(one.differs for one in same.comparisons().values())
    assert "no metric differs measurably" in conclude_comparison(same)[1]
    assert distribution_distances(*same.observations()) == [0.0] * 7
    first, moved = same.observations()[0], np.arange(7.0) * 10.0
    assert distribution_distances(first, first + moved)[0] == 0.0
    assert distribution_distances(first, first + moved)[6] == 1.0
    assert distribution_distances(first, np.zeros((0, 0))) == []
    single = compare_sides([("a", sim(1, 2))], [("b", real())])
    assert conclude_comparison(single)[1].startswith("too few pairs (1)")


def on_hardware(recording: Recording, lateness: float = 0.0) -> Recording:
    """The recording as if its robot had been real, with this lateness of every tick."""
    episodes = [
        replace(one, lateness=np.full(len(one.stamps), lateness)) for one in recording.episodes
    ]
    return replace(recording, episodes=tuple(episodes))


def test_swapped_sides_are_an_error_and_a_wrong_kind_is_noted() -> None:
    robot = [("real.mcap", on_hardware(real()))]
    with pytest.raises(ConfigError, match=r"real\.mcap: is of a real robot"):
        compare_sides(robot, [("sim.mcap", sim())])
    assert not any("named as" in note for note in compare_sides([("sim.mcap", sim())], robot).notes)
    assert "named as sim" in compare_sides(robot, robot).notes[0]
    late = [("real.mcap", on_hardware(real(), 0.003))]
    assert "100% of its ticks were late" in compare_sides([("sim.mcap", sim())], late).notes[2]


def test_other_policies_are_said_first() -> None:
    policies = [{"file": f"/a/{n}.onnx", "sha256": n * 64} for n in "ab"]
    logs = [replace(sim(), header={"about": {"policy": policy}}) for policy in policies]
    found = compare_sides([("a", logs[0])], [("b", logs[1])])
    assert "policies differ: a.onnx" in conclude_comparison(found)[0]
    assert "policies differ" in str(comparison_table(found).title)
    same = compare_sides([("a", logs[0])], [("b", logs[0])])
    assert "policies" not in conclude_comparison(same)[0]


def test_pairs_with_other_goals_are_left_out() -> None:
    goal = {"goal": [1.0, 0.0]}
    first, *others = [replace(one, info={**one.info, **goal}) for one in sim().episodes]
    told = replace(sim(), episodes=(first, *others))
    moved = replace(first, info={**first.info, "goal": [9.0, 0.0]})
    other = replace(sim(), episodes=(moved, *others))
    found = compare_sides([("a", told)], [("b", other)])
    assert len(found.pairs) == 5
    assert "seed 0 of b: left out, another goal" in found.notes
    with pytest.raises(ConfigError, match="no pair has the same goal: seed 0 of a and of b differ"):
        compare_sides([("a", told)], [("b", replace(sim(), episodes=(moved,)))])


def test_the_same_goal_from_another_start_is_the_same() -> None:
    """Goals are in the odometry frame; the start is where that lies in a world."""
    goal = {"goal": [-1.46, -4.35]}
    simulated = [
        replace(one, info={**one.info, **goal, "start": [3.2, -3.39, -2.3]})
        for one in sim().episodes
    ]
    driven = [replace(one, info={**one.info, **goal}) for one in sim().episodes]
    one, other = ([("a", replace(sim(), episodes=tuple(side)))] for side in (simulated, driven))
    assert len(compare_sides(one, other).pairs) == len(driven)


def test_lengths_and_turns_by_closed_form() -> None:
    outcome = sides().outcomes[0][0]
    straight = np.column_stack([np.linspace(0.0, 2.0, 9), np.zeros(9), np.linspace(0.0, 1.0, 9)])
    outcome = replace(outcome, episode=replace(outcome.episode, poses=straight))
    assert EPISODE_METRICS["path"].of(outcome) == pytest.approx(2.0)
    assert EPISODE_METRICS["smoothness"].of(outcome) == pytest.approx(0.5)


def test_another_task_robot_and_an_empty_recording_are_refused() -> None:
    with pytest.raises(ConfigError, match="sim has seeds 0 to 5, real seeds 7 to 8"):
        compare_sides([("a", sim())], [("b", sim(7, 9))])
    barn = replace(real(), header={"about": {"env": {"id": "acsar_gym/Barn-v1"}}})
    with pytest.raises(ConfigError, match=r"b: is of acsar_gym/Barn-v1, but a of acsar_gym/Point"):
        compare_sides([("a", sim())], [("b", barn)])
    large = replace(real(), config=ACSAR.with_(wheel_radius=0.1))
    with pytest.raises(ConfigError, match=r"b: is of another robot: wheel_radius is 0\.1 m"):
        compare_sides([("a", sim())], [("b", large)])
    with pytest.raises(ConfigError, match="b: holds no episode that was driven"):
        compare_sides([("a", sim())], [("b", replace(real(), episodes=()))])


def test_newcombes_own_example() -> None:
    """The first of his table; he subtracts the other way round."""
    found = paired_rate_interval(36, 12, 2, 0)
    assert (-found[1], -found[0]) == pytest.approx((0.0569, 0.3404), abs=5e-5)
    one, other = paired_rate_interval(19, 7, 1, 3), paired_rate_interval(19, 1, 7, 3)
    assert one == pytest.approx((-other[1], -other[0]))


def test_rates_are_second_minus_first_and_equal_ones_arent_certain() -> None:
    better = compare_values(([0.0] * 20, [1.0] * 20), [(0.0, 1.0)] * 20, rates=True)
    assert better.values == (0.0, 1.0)
    assert better.difference == 1.0
    assert better.interval[0] > 0.7
    assert better.differs
    same = compare_values(([1.0] * 20, [1.0] * 20), [(1.0, 1.0)] * 20, rates=True)
    assert same.difference == 0.0
    assert same.interval[0] < -0.05
    assert same.interval[1] > 0.05
    assert not same.differs


def test_pairing_sees_what_means_hide() -> None:
    rng = np.random.default_rng(0)
    first = rng.uniform(2.0, 8.0, 20)
    second = first + rng.normal(0.2, 0.05, 20)
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    found = compare_values((first.tolist(), second.tolist()), pairs)
    assert found.intervals[0][1] > found.values[1]
    assert found.interval[0] < 0.2 < found.interval[1]
    assert found.differs


def test_what_isnt_known_is_left_out() -> None:
    found = compare_values(([1.0, math.nan], [2.0]), [(1.0, 2.0), (math.nan, 3.0)])
    assert (found.counts, found.pairs, found.difference) == ((1, 1), 1, 1.0)
    nothing = compare_values(([], []), [], rates=True)
    assert math.isnan(nothing.difference)
    assert math.isnan(nothing.interval[0])
    assert not nothing.differs
