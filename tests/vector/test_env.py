"""The batch of planar robots against the single environment, and Gymnasium's rules for batches."""

from __future__ import annotations

import signal
import threading
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from mover_tools import HALL
from varied import RANGES

from acsar_gym import RobotConfig, RobotEnv, World
from acsar_gym.envs import ObstacleGoalVectorEnv, PathFollowVectorEnv, PointGoalVectorEnv
from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.physics import Randomization
from acsar_gym.tasks import PointGoal
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.threads import Threads
from acsar_gym.worlds import Region, generators

pytestmark = pytest.mark.xdist_group(__name__)
ENV_ID = "acsar_gym/PointGoal-v0"


def batch(num: int = 4, **options: Any) -> PointGoalVectorEnv:
    return PointGoalVectorEnv(num, **{"max_episode_steps": 200, **options})


def test_make_vec_finds_the_batch() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make_vec(ENV_ID, 8, vectorization_mode="vector_entry_point")
    assert isinstance(env.unwrapped, PointGoalVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    obs, infos = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert infos["_goal_distance"].all()
    obs, rewards, terminated, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(obs)
    assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
    env.close()
    env.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_autoreset_is_gymnasiums_own(mode: AutoresetMode) -> None:
    """Step for step what SyncVectorEnv makes of four single environments, infos included."""
    ours = batch(goal_distance=(0.3, 0.6), max_episode_steps=25, autoreset_mode=mode)
    theirs = gymnasium.make_vec(
        ENV_ID,
        4,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        link="planar",
        goal_distance=(0.3, 0.6),
        max_episode_steps=25,
    )
    ours.reset(seed=7)
    theirs.reset(seed=7)
    rng, ended = np.random.default_rng(1), 0
    for _ in range(120):
        acts = rng.uniform(-1.0, 1.0, (4, 2)).astype(np.float32)
        mine, expected = ours.step(acts), theirs.step(acts)
        for have, want in zip(mine[:4], expected[:4], strict=True):
            assert have == pytest.approx(want, abs=1e-6)
        compare_infos(mine[4], expected[4])
        ended += int((mine[2] | mine[3]).sum())
    ours.close()
    theirs.close()
    assert ended > 10


def compare_infos(mine: dict[str, Any], expected: dict[str, Any]) -> None:
    """What Gymnasium reports we report, too, wherever its mask is set."""
    for key, want in expected.items():
        if key.startswith("_"):
            continue
        mask = expected[f"_{key}"]
        assert (mine[f"_{key}"] == mask).all()
        if isinstance(want, dict):
            compare_infos(mine[key], want)
        elif want.dtype == object:
            for index in np.flatnonzero(mask):
                assert mine[key][index] == pytest.approx(want[index], abs=1e-6)
        else:
            assert mine[key][mask] == pytest.approx(want[mask], abs=1e-6)


def test_without_autoreset_the_user_resets_by_mask() -> None:
    env = batch(max_episode_steps=5, autoreset_mode="Disabled")
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros((4, 2)))
    with pytest.raises(ConfigError, match="env 0 has ended"):
        env.step(np.zeros((4, 2)))
    before = env.batch.read(*layout.ROWS)
    mask = np.array([True, False, True, False])
    env.reset(options={"reset_mask": mask})
    assert (env.batch.read(*layout.ROWS)[:, ~mask] == before[:, ~mask]).all()
    with pytest.raises(ConfigError, match="env 1 has ended"):
        env.step(np.zeros((4, 2)))
    env.close()


def rollout(env: RobotVectorEnv, seed: int = 3) -> np.ndarray[Any, Any]:
    first = env.reset(seed=seed)[0]
    rng = np.random.default_rng(9)
    acts = rng.uniform(-1.0, 1.0, (50, env.num_envs, 2))
    return np.array([first, *(env.step(act)[0] for act in acts)])


@pytest.mark.parametrize("randomization", [None, RANGES], ids=["plain", "randomized"])
def test_results_do_not_depend_on_threads_or_history(randomization: Any) -> None:
    one = rollout(batch(300, threads=1, randomization=randomization))
    two = rollout(batch(300, threads=2, randomization=randomization))
    again = batch(300, threads=1, randomization=randomization)
    rollout_twice = (rollout(again, seed=99), rollout(again))[1]
    assert (one == two).all()
    assert (one == rollout_twice).all()


def test_movers_do_not_depend_on_threads_or_history() -> None:
    one, two = (ObstacleGoalVectorEnv(300, worlds=HALL, threads=count) for count in (1, 2))
    first, second = rollout(one), rollout(two)
    assert (first == second).all()
    assert (rollout(one) == first).all()
    for name, numbers in one.batch.info().items():
        assert np.array_equal(numbers, two.batch.info()[name], equal_nan=True)


class Interrupted:
    """A batch in which Ctrl-C comes within the first call of this, in the midst of a share."""

    def __init__(self, env: RobotVectorEnv, name: str) -> None:
        self.whole, self.left = getattr(env.batch, name), 1
        setattr(env.batch, name, self)

    def __call__(self, *arguments: Any) -> None:
        *others, first, last = arguments
        self.left -= threading.current_thread() is threading.main_thread()
        if self.left == 0:
            self.left = -1
            self.whole(*others, first, (first + last) // 2)
            signal.raise_signal(signal.SIGINT)
        self.whole(*others, first, last)


@pytest.mark.parametrize("place", ["_begin", "_drive"])
def test_after_ctrl_c_a_seeded_reset_begins_anew(place: str) -> None:
    """Whatever it interrupts, the next seeded rollout is that of a new batch."""
    options: dict[str, Any] = {"worlds": "open:3", "max_episode_steps": 20, "threads": 1}
    expected = rollout(ObstacleGoalVectorEnv(400, **options))
    env = ObstacleGoalVectorEnv(400, **options)
    env._threads = Threads(3)
    Interrupted(env, place)
    with pytest.raises(KeyboardInterrupt):
        rollout(env, seed=99)
    with pytest.raises(ConfigError, match="reset"):
        env.step(np.zeros((400, 2)))
    if env.batch.seeded:
        with pytest.raises(ConfigError, match="after an interrupt"):
            env.reset(options={"reset_mask": np.arange(400) < 200})
    assert (rollout(env) == expected).all()
    env.close()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_envs": 2.5}, "num_envs"),
        ({"max_episode_steps": 0}, "max_episode_steps"),
        ({"threads": 0}, "threads"),
        ({"randomization": {"frictoin": (0.5, 1.0)}}, "'friction'"),
        ({"render_mode": "human"}, "render_mode"),
        ({"link": "bullet"}, "link"),
        ({"faults": {"unplug_rate": 0.1}}, "'dropped_lines' and 'late_lines'"),
        ({"faults": {"late_lines": 0.1, "lateness": 50.0}}, "lateness"),
    ],
)
def test_bad_options_are_one_clear_error(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named) as caught:
        PointGoalVectorEnv(**{"num_envs": 2, **options})
    assert "\n" not in str(caught.value)


def test_bad_actions_and_seeds_are_one_clear_error_and_change_nothing() -> None:
    env = batch()
    with pytest.raises(ConfigError, match="call reset"):
        env.step(np.zeros((4, 2)))
    env.reset(seed=0)
    with pytest.raises(CommandError, match=r"\(3, 2\)"):
        env.step(np.zeros((3, 2)))
    bad = np.zeros((4, 2))
    bad[2, 1] = bad[3, 0] = np.nan
    with pytest.raises(CommandError, match="env 2"):
        env.step(bad)
    unreadable: list[Any] = [
        torch.zeros((4, 2), requires_grad=True),
        [["0.5", "0.5"]] * 4,
        None,
        [[0.0, 0.0], [0.0]],
        np.zeros((4, 2), complex),
    ]
    for actions in unreadable:
        with pytest.raises(CommandError, match=r"^action[^\n]*$"):
            env.step(actions)
    assert env.batch.read("steps").tolist() == [[0.0] * 4]
    seeds: list[Any] = [[1, 2], "abc", "abcd", -5, [0, 1, 2, -1], 2.5]
    for seed in seeds:
        with pytest.raises(ConfigError, match="seed"):
            env.reset(seed=seed)
    env.step(np.zeros((4, 2)))
    env.close()


@pytest.mark.parametrize("kind", [RobotVectorEnv, RobotEnv])
def test_randomization_true_is_that_of_a_training(kind: Any) -> None:
    told = []
    for given in (True, Randomization.measured(RobotConfig.of(None))):
        env = kind(PointGoal, randomization=given)
        told.append({k: v for k, v in env.reset(seed=0)[1].items() if k.startswith("drawn_")})
        env.close()
    assert told[0]
    np.testing.assert_equal(told[0], told[1])
    env = kind(PointGoal, randomization=False)
    assert not [name for name in env.reset(seed=0)[1] if name.startswith("drawn_")]
    env.close()


def test_options_hold_until_the_next_reset_of_the_robot() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:8", max_episode_steps=2, threads=1)
    everything = set(range(8))

    def worlds(robots: slice = slice(None), episodes: int = 6) -> set[float]:
        found: set[float] = set()
        for _ in range(3 * episodes):
            found |= set(env.step(np.zeros((40, 2)))[4]["world"][robots].tolist())
        return found

    env.reset(seed=0, options={"world": 5})
    assert worlds() == {5}
    env.reset(options={"world": 3, "reset_mask": np.arange(40) < 20})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == ({3}, {5})
    env.reset(options={"reset_mask": np.arange(40) < 20})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == (everything, {5})
    env.reset(seed=1)
    assert worlds() == everything
    again = env.reset(seed=1)[1]["world"]
    env.reset(seed=1, options={"world": 5})
    assert (env.reset(seed=1)[1]["world"] == again).all()
    env.close()


def test_a_curriculum_goes_on_without_ending_episodes() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:30", max_episode_steps=3, threads=1)
    levels = {number: generators.draw_difficulty("open", number) for number in range(30)}
    env.reset(seed=0, options={"difficulty": (0.0, 0.3)})
    for low, high in ((0.2, 0.5), (0.5, 1.0)):
        stays = [name for name in layout.ROWS if name not in layout.OPTIONS]
        before = env.batch.read(*stays)
        env.set_options({"difficulty": (low, high)})
        assert (env.batch.read(*stays) == before).all()
        for _ in range(4):
            *_, info = env.step(np.zeros((40, 2)))
        drawn = [levels[int(number)] for number in info["world"]]
        assert low <= min(drawn) <= max(drawn) <= high
        assert len(set(drawn)) > 3
    env.close()


PATH = World(goal=Region(3.0, 2.0), path=np.array([[0.0, 0.0], [2.0, 0.0], [3.0, 2.0]]))


@pytest.mark.parametrize(
    ("kind", "options", "named"),
    [
        (ObstacleGoalVectorEnv, {"world": 8}, "world of robot 0 = 8"),
        (ObstacleGoalVectorEnv, {"world": [0, 0.5]}, "world of robot 1 = 0.5"),
        (ObstacleGoalVectorEnv, {"world": World()}, "world"),
        (ObstacleGoalVectorEnv, {"goal": [1.0, 2.0, 3.0]}, "goal"),
        (ObstacleGoalVectorEnv, {"difficulty": 0.5}, "difficulty"),
        (
            ObstacleGoalVectorEnv,
            {"world": [np.nan, 3], "difficulty": (0.0, 1.0)},
            "'world' and 'difficulty' of robot 1 contradict",
        ),
        (ObstacleGoalVectorEnv, {"wrld": 3}, "'world'"),
        (ObstacleGoalVectorEnv, {"reset_mask": [True]}, "reset_mask"),
        (ObstacleGoalVectorEnv, 3, "mapping"),
        (PointGoalVectorEnv, {"goal": (9.0, 9.0)}, "goal"),
        (PathFollowVectorEnv, {"difficulty": (0.0, 1.0)}, "difficulty"),
    ],
)
def test_bad_options_of_a_reset_change_nothing(kind: Any, options: Any, named: str) -> None:
    worlds: dict[Any, Any] = {ObstacleGoalVectorEnv: "open:8", PathFollowVectorEnv: PATH}
    env = kind(2, threads=1, **({"worlds": worlds[kind]} if kind in worlds else {}))
    env.reset(seed=0)
    before = env.batch.read(*layout.ROWS)
    with pytest.raises(ConfigError, match=named):
        env.reset(options=options)
    with pytest.raises(ConfigError, match=named):
        env.set_options(options)
    assert (env.batch.read(*layout.ROWS) == before).all()
    env.close()


# Fleets


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"robot": "drawn:x"}, "must be like 'drawn:17'"),
        (
            {"robot": ["acsar", RobotConfig().with_(lidar={"rays": 90})], "sensors": ["lidar"]},
            "acsar has lidar.rays = 64, number 1 90: must be the same for all robots of a batch",
        ),
    ],
)
def test_a_fleet_that_cannot_be_stepped_together_is_refused(
    options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        batch(2, **options)


@pytest.mark.parametrize("robot", [["acsar", "husky"], "drawn:train"])
def test_the_single_env_refuses_a_fleet(robot: Any) -> None:
    with pytest.raises(ConfigError, match="a fleet is for a batch of robots"):
        gymnasium.make(ENV_ID, link="planar", robot=robot)
