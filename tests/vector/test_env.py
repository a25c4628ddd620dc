"""Batches by Gymnasium's rules: autoreset, seeds, options, errors."""

from __future__ import annotations

import copy
import signal
import threading
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
Rows = np.ndarray[Any, Any]


def make_batch(num_envs: int = 4, **options: Any) -> Any:
    return PointGoalVectorEnv(num_envs, **{"max_episode_steps": 200, **options})


def test_make_vec_finds_the_batch() -> None:
    env = gymnasium.make_vec(ENV_ID, 8, vectorization_mode="vector_entry_point")
    assert isinstance(env.unwrapped, PointGoalVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, infos = env.reset(seed=0)
    assert env.observation_space.contains(observations)
    assert infos["_goal_distance"].all()
    observations, rewards, terminated, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observations)
    assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
    env.close()
    env.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_autoreset_is_gymnasiums_own(mode: AutoresetMode) -> None:
    """Step for step what SyncVectorEnv makes of four single environments, infos included."""
    options: dict[str, Any] = {"goal_distance": (0.3, 0.6), "max_episode_steps": 25}
    batch = make_batch(autoreset_mode=mode, **options)
    reference = gymnasium.make_vec(
        ENV_ID,
        4,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        link="planar",
        **options,
    )
    batch.reset(seed=7)
    reference.reset(seed=7)

    rng = np.random.default_rng(1)
    ended = 0
    for _ in range(120):
        actions = rng.uniform(-1.0, 1.0, (4, 2)).astype(np.float32)
        *results, info = batch.step(actions)
        *expected, expected_info = reference.step(actions)
        for array, expected_array in zip(results, expected, strict=True):
            assert array == pytest.approx(expected_array, abs=1e-6)
        compare_infos(info, expected_info)
        ended += int((results[2] | results[3]).sum())
    batch.close()
    reference.close()
    assert ended > 10


def compare_infos(info: dict[str, Any], expected: dict[str, Any]) -> None:
    """The batch reports what Gymnasium reports, wherever its mask is set."""
    for key, values in expected.items():
        if key.startswith("_"):
            continue
        mask = expected[f"_{key}"]
        assert (info[f"_{key}"] == mask).all()
        if isinstance(values, dict):
            compare_infos(info[key], values)
            continue
        for value, expected_value in zip(info[key][mask], values[mask], strict=True):
            assert value == pytest.approx(expected_value, abs=1e-6)


def test_without_autoreset_the_user_resets_by_mask() -> None:
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
    env.close()


def rollout(env: RobotVectorEnv, seed: int = 3) -> Rows:
    first = env.reset(seed=seed)[0]
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
def test_results_do_not_depend_on_threads_or_history(kind: Any, options: dict[str, Any]) -> None:
    alone, shared = (kind(300, threads=threads, **options) for threads in (1, 2))
    expected = rollout(alone)
    assert (rollout(shared) == expected).all()
    for name, numbers in alone.batch.info().items():
        assert np.array_equal(numbers, shared.batch.info()[name], equal_nan=True)
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


@pytest.mark.parametrize("place", ["_finish_step", "_drive"])
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
    ("options", "message"),
    [
        ({"num_envs": 2.5}, "num_envs"),
        ({"max_episode_steps": 0}, "max_episode_steps"),
        ({"threads": 0}, "threads"),
        ({"randomization": {"frictoin": (0.5, 1.0)}}, "'friction'"),
        ({"render_mode": "human"}, "render_mode"),
        ({"link": "bullet"}, "link"),
        ({"faults": {"dropped_lines": 0.1}}, "faults = .*vectorization_mode='sync' or 'async'"),
        ({"robot": "drawn:x"}, "must be like 'drawn:17'"),
        (
            {"robot": ["acsar", RobotConfig().with_(lidar={"rays": 90})], "sensors": ["lidar"]},
            "acsar has lidar.rays = 64, number 1 90: must be the same for all robots of a batch",
        ),
    ],
)
def test_bad_options_are_one_clear_error(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        PointGoalVectorEnv(**{"num_envs": 2, **options})
    assert "\n" not in str(caught.value)


UNREADABLE: list[Any] = [
    np.zeros((3, 2)),
    np.array([[0.0, 0.0], [0.0, 0.0], [0.0, np.nan], [0.0, 0.0]]),
    torch.zeros((4, 2), requires_grad=True),
    [["0.5", "0.5"]] * 4,
    None,
    [[0.0, 0.0], [0.0]],
]


def test_bad_actions_and_seeds_change_nothing() -> None:
    env = make_batch()
    with pytest.raises(ConfigError, match="call reset"):
        env.step(np.zeros((4, 2)))
    env.reset(seed=0)
    for actions in UNREADABLE:
        with pytest.raises(CommandError, match=r"^(action|env 2)[^\n]*$"):
            env.step(actions)
    assert env.batch.read("steps").tolist() == [[0.0] * 4]
    for seed in ([1, 2], "abc", "abcd", -5, [0, 1, 2, -1], 2.5):
        with pytest.raises(ConfigError, match="seed"):
            env.reset(seed=seed)
    env.step(np.zeros((4, 2)))
    env.close()


def test_a_closed_batch_raises_an_error() -> None:
    env = make_batch()
    env.reset(seed=0)
    env.close()
    with pytest.raises(ConfigError, match="closed batch"):
        env.step(np.zeros((4, 2)))
    with pytest.raises(ConfigError, match="closed batch"):
        env.reset()


@pytest.mark.parametrize("kind", [RobotVectorEnv, RobotEnv])
def test_randomization_true_is_that_of_a_training(kind: Any) -> None:
    def draw(randomization: Any) -> dict[str, Any]:
        env = kind(PointGoal, randomization=randomization)
        info = env.reset(seed=0)[1]
        env.close()
        return {name: value for name, value in info.items() if name.startswith("drawn_")}

    drawn = draw(True)
    assert drawn
    np.testing.assert_equal(drawn, draw(Randomization.measured(RobotConfig.of(None))))
    assert not draw(False)


def test_options_hold_until_the_next_reset_of_the_robot() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:8", max_episode_steps=2, threads=1)
    everything = set(range(8))

    def worlds(robots: slice = slice(None)) -> set[float]:
        numbers = [env.step(np.zeros((40, 2)))[4]["world"][robots] for _ in range(18)]
        return set(np.ravel(numbers))

    env.reset(seed=0, options={"world": 5})
    assert worlds() == {5}
    env.reset(options={"world": 3, "reset_mask": np.arange(40) < 20})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == ({3}, {5})
    env.reset(options={"reset_mask": np.arange(40) < 20})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == (everything, {5})
    env.reset(seed=1)
    assert worlds() == everything
    env.close()


def test_a_curriculum_goes_on_without_ending_episodes() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:30", max_episode_steps=3, threads=1)
    levels = {number: generators.draw_difficulty("open", number) for number in range(30)}
    lasting = [name for name in layout.ROWS if name not in layout.OPTIONS]
    env.reset(seed=0, options={"difficulty": (0.0, 0.3)})
    for low, high in ((0.2, 0.5), (0.5, 1.0)):
        fields = env.batch.read(*lasting)
        env.set_options({"difficulty": (low, high)})
        assert (env.batch.read(*lasting) == fields).all()
        for _ in range(4):
            *_, info = env.step(np.zeros((40, 2)))
        drawn = [levels[int(number)] for number in info["world"]]
        assert low <= min(drawn) <= max(drawn) <= high
        assert len(set(drawn)) > 3
    env.close()


PATH = World(goal=Region(3.0, 2.0), path=np.array([[0.0, 0.0], [2.0, 0.0], [3.0, 2.0]]))


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (ObstacleGoalVectorEnv, {"world": 8}, "world of robot 0 = 8"),
        (ObstacleGoalVectorEnv, {"world": [0, 0.5]}, "world of robot 1 = 0.5"),
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
def test_bad_options_of_a_reset_change_nothing(kind: Any, options: Any, message: str) -> None:
    worlds: dict[Any, Any] = {ObstacleGoalVectorEnv: "open:8", PathFollowVectorEnv: PATH}
    env = kind(2, threads=1, **({"worlds": worlds[kind]} if kind in worlds else {}))
    env.reset(seed=0)
    fields = env.batch.read(*layout.ROWS)
    for method in (env.reset, env.set_options):
        with pytest.raises(ConfigError, match=message):
            method(options=options)
    assert (env.batch.read(*layout.ROWS) == fields).all()
    env.close()


@pytest.mark.parametrize("robot", [["acsar", "husky"], "drawn:train"])
def test_the_single_env_refuses_a_fleet(robot: Any) -> None:
    with pytest.raises(ConfigError, match="a fleet is for a batch of robots"):
        gymnasium.make(ENV_ID, link="planar", robot=robot)
