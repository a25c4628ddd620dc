"""Batches by Gymnasium's rules: autoreset, seeds, options, errors."""

from __future__ import annotations

import copy
import signal
import threading
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from scenes import HALL, RANGES

from acsar_gym import RobotConfig
from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.threads import Threads
from acsar_gym.worlds import generators

pytestmark = pytest.mark.xdist_group(__name__)
Rows = np.ndarray[Any, Any]


def make_batch(num_envs: int = 4, **options: Any) -> Any:
    return PointGoalVectorEnv(num_envs, **{"max_episode_steps": 200, **options})


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_autoreset_is_gymnasiums_own(mode: AutoresetMode, compare: Any) -> None:
    """Step for step what SyncVectorEnv makes of four single environments, infos included."""
    options: dict[str, Any] = {"goal_distance": (0.3, 0.6), "max_episode_steps": 25}
    assert compare("PointGoal", options, 120, range(4), 4, mode=mode) > 10


def test_reset_mask_without_autoreset() -> None:
    env = make_batch(max_episode_steps=5, autoreset_mode="Disabled")
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros((4, 2)))
    with pytest.raises(ConfigError, match="env 0 has ended"):
        env.step(np.zeros((4, 2)))
    fields = env.batch.read(*layout.ROWS)
    mask = np.array([True, False, True, False])
    env.reset(options={"reset_mask": mask})
    assert (env.batch.read(*layout.ROWS)[:, ~mask] == fields[:, ~mask]).all()
    with pytest.raises(ConfigError, match="env 1 has ended"):
        env.step(np.zeros((4, 2)))


def rollout(env: RobotVectorEnv, seed: int = 3) -> Rows:
    first = env.reset(seed=seed)[0]
    assert env.observation_space.contains(first)
    actions = np.random.default_rng(9).uniform(-1.0, 1.0, (50, env.num_envs, 2))
    return np.array([first, *(env.step(action)[0] for action in actions)])


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (PointGoalVectorEnv, {}),
        (PointGoalVectorEnv, {"randomization": RANGES}),
        (ObstacleGoalVectorEnv, {"worlds": HALL}),
    ],
    ids=["plain", "randomized", "movers"],
)
def test_threads_and_history_do_not_change_results(kind: Any, options: dict[str, Any]) -> None:
    alone, shared = (kind(300, threads=threads, **options) for threads in (1, 2))
    expected = rollout(alone)
    assert (rollout(shared) == expected).all()
    np.testing.assert_equal(shared.batch.info(), alone.batch.info())
    rollout(alone, seed=99)
    assert (rollout(alone) == expected).all()
    assert (rollout(copy.deepcopy(make_batch(2))) == rollout(make_batch(2))).all()


class Interrupted:
    """A batch in which Ctrl-C comes in the first call of a method, while threads work."""

    def __init__(self, env: RobotVectorEnv, name: str) -> None:
        self.method = getattr(env.batch, name)
        self.is_due = True
        setattr(env.batch, name, self)

    def __call__(self, first: int, last: int) -> None:
        if self.is_due and threading.current_thread() is threading.main_thread():
            self.is_due = False
            self.method(first, (first + last) // 2)
            signal.raise_signal(signal.SIGINT)
        self.method(first, last)


def test_reset_after_ctrl_c_starts_again() -> None:
    """The next seeded rollout is that of a new batch."""
    options: dict[str, Any] = {"worlds": "open:3", "max_episode_steps": 20, "threads": 1}
    expected = rollout(ObstacleGoalVectorEnv(400, **options))
    env = ObstacleGoalVectorEnv(400, **options)
    env._threads = Threads(3)
    Interrupted(env, "_drive")
    with pytest.raises(KeyboardInterrupt):
        rollout(env, seed=99)
    with pytest.raises(ConfigError, match="reset"):
        env.step(np.zeros((400, 2)))
    with pytest.raises(ConfigError, match="after an interrupt"):
        env.reset(options={"reset_mask": np.arange(400) < 200})
    assert (rollout(env) == expected).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"faults": {"dropped_lines": 0.1}}, "faults = .*vectorization_mode='sync' or 'async'"),
        (
            {"robot": ["acsar", RobotConfig().with_(lidar={"rays": 90})], "sensors": ["lidar"]},
            "acsar has lidar.rays = 64, number 1 90: must be the same for all robots of a batch",
        ),
    ],
)
def test_batch_options_that_are_wrong_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PointGoalVectorEnv(**{"num_envs": 2, **options})


def test_batch_accepts_faults_that_are_none() -> None:
    PointGoalVectorEnv(2, faults={"lateness": 0.1}).close()


def test_batch_actions_and_seeds_that_are_wrong_change_nothing() -> None:
    env = make_batch()
    still = np.zeros((4, 2))
    with pytest.raises(ConfigError, match="call reset"):
        env.step(still)

    env.reset(seed=0)
    holed = np.where([[0.0], [0.0], [1.0], [0.0]], np.nan, 0.0) + still
    for actions, message in ((still[:3], r"of shape \(3, 2\)"), (holed, "action of env 2 is")):
        with pytest.raises(CommandError, match=message):
            env.step(actions)
    for seed in ([1, 2], "abc", -5):
        with pytest.raises(ConfigError, match="seed"):
            env.reset(seed=seed)
    assert env.batch.read("steps").tolist() == [[0.0] * 4]
    env.close()
    for call in (env.reset, lambda: env.step(still)):
        with pytest.raises(ConfigError, match="closed batch"):
            call()


def test_reset_options_hold_until_the_next_reset() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:8", max_episode_steps=2, threads=1)
    everything = set(range(8))

    def worlds(robots: slice = slice(None)) -> set[float]:
        numbers = [env.step(np.zeros((40, 2)))[4]["world"][robots] for _ in range(18)]
        return set(np.ravel(numbers))

    first = np.arange(40) < 20
    env.reset(seed=0, options={"world": 5})
    assert worlds() == {5}
    env.reset(options={"world": 3, "reset_mask": first})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == ({3}, {5})
    env.reset(options={"reset_mask": first})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == (everything, {5})


def test_set_options_ends_no_episodes() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:30", max_episode_steps=3, threads=1)
    levels = {number: generators.draw_difficulty("open", number) for number in range(30)}
    lasting = [name for name in layout.ROWS if name not in layout.OPTIONS]
    env.reset(seed=0, options={"difficulty": (0.0, 0.3)})
    fields = env.batch.read(*lasting)
    env.set_options({"difficulty": (0.5, 1.0)})
    assert (env.batch.read(*lasting) == fields).all()
    for _ in range(4):
        *_, info = env.step(np.zeros((40, 2)))
    drawn = [levels[int(number)] for number in info["world"]]
    assert 0.5 <= min(drawn) <= max(drawn) <= 1.0
    assert len(set(drawn)) > 3


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (ObstacleGoalVectorEnv, {"world": [0, 0.5]}, "world of robot 1 = 0.5"),
        (ObstacleGoalVectorEnv, {"difficulty": 0.5}, "difficulty"),
        (
            ObstacleGoalVectorEnv,
            {"world": [np.nan, 3], "difficulty": (0.0, 1.0)},
            "'world' and 'difficulty' of robot 1 contradict",
        ),
        (ObstacleGoalVectorEnv, {"reset_mask": [True]}, "reset_mask"),
        (PointGoalVectorEnv, {"goal": (9.0, 9.0)}, "goal"),
    ],
)
def test_reset_options_that_are_wrong_change_nothing(kind: Any, options: Any, message: str) -> None:
    worlds = {"worlds": "open:8"} if kind is ObstacleGoalVectorEnv else {}
    env = kind(2, threads=1, **worlds)
    env.reset(seed=0)
    fields = env.batch.read(*layout.ROWS)
    for method in (env.reset, env.set_options):
        with pytest.raises(ConfigError, match=message):
            method(options=options)
    assert (env.batch.read(*layout.ROWS) == fields).all()
