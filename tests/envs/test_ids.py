"""What holds for every registered environment, in PyBullet, planar and over a tty."""

from __future__ import annotations

import inspect
import math
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import acsar_gym
from acsar_gym import RobotConfig, RobotEnv
from acsar_gym.envs import CrowdEnv, ObstacleGoalEnv
from acsar_gym.envs.ids import full_id, make_vec
from acsar_gym.envs.robot_env import EnvOptions
from acsar_gym.errors import AcsarError, AcsarWarning
from acsar_gym.links.faults import Faults
from acsar_gym.physics import Randomization
from acsar_gym.registration import snake_case
from acsar_gym.resources import AGENTS
from acsar_gym.tasks import PointGoal

POINT_GOAL = "acsar_gym/PointGoal-v0"
OBSTACLE_GOAL = "acsar_gym/ObstacleGoal-v1"
ARC = np.array([0.3, 0.1], np.float32)


def test_ids_pass_gymnasiums_checker(
    env_id: str, link: str, monkeypatch: pytest.MonkeyPatch, make: Any
) -> None:
    """In every render mode, without a display: one warning states that "human" shows nothing."""
    monkeypatch.delenv("DISPLAY", raising=False)
    env = make(env_id, link)
    with pytest.warns() as caught:
        check_env(env.unwrapped)
    assert [warning.category for warning in caught] == [AcsarWarning]
    assert "needs a display" in str(caught[0].message)


def test_manual_is_the_class(env_id: str, make: Any) -> None:
    """With observation, reward, end, the task's options and the weights of its reward."""
    env = make(env_id).unwrapped
    manual = str(type(env).__doc__)
    for section in ("Observation space", "Reward", "Start and end", "Arguments"):
        assert f"## {section}" in manual
    shared = str(RobotEnv.__doc__)
    names = {"link", "robot", "weights", *EnvOptions.names()}
    assert [name for name in names if f"- `{name}`:" not in shared] == []
    options = inspect.signature(type(env.task)).parameters
    assert [name for name in options if f"- `{name}`:" not in manual] == []
    manuals = manual + str(ObstacleGoalEnv.__doc__) + str(CrowdEnv.__doc__)
    for name, weight in env.task.weights._asdict().items():
        assert f"| `{name}` | {weight:g} |" in manuals


def test_full_id_is_the_newest_version() -> None:
    assert [*map(full_id, ("barn", "dyna_barn", "mine/Task-v0"))] == [
        "acsar_gym/Barn-v1",
        "acsar_gym/DynaBarn-v0",
        "mine/Task-v0",
    ]


ROLLOUT = """
import hashlib, sys, gymnasium, numpy as np
for name in sys.argv[1:]:
    env_id, link = name.split(" ")
    env = gymnasium.make("acsar_gym:" + env_id, link=link)
    digest, rng = hashlib.sha256(), np.random.default_rng(5)
    for seed in (7, None, None):
        observation, info = env.reset(seed=seed)
        digest.update(observation.tobytes())
        for _ in range(60):
            step = env.step(rng.uniform(-1, 1, 2).astype(np.float32))
            digest.update(step[0].tobytes() + repr(step[1:]).encode())
            if step[2]:
                break
    print(name, digest.hexdigest())
"""


def test_seed_gives_two_processes_the_same_bits() -> None:
    names = [
        f"{env_id} {link}"
        for env_id in (POINT_GOAL, OBSTACLE_GOAL)
        for link in ("planar", "bullet")
    ]
    command = [sys.executable, "-c", ROLLOUT, *names]
    first, second = (subprocess.check_output(command, text=True).splitlines() for _ in range(2))
    assert first == second
    assert len({line.split(" ")[-1] for line in first}) == len(names)


def test_info_has_the_same_floats_at_every_step(env_id: str, make: Any) -> None:
    env = make(env_id)
    _, first = env.reset(seed=0)
    for _ in range(20):
        *_, info = env.step(ARC)
        assert info.keys() == first.keys()
        assert all(type(value) is float for value in info.values())
        assert not any(math.isnan(value) for value in info.values())


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        (POINT_GOAL, {"robot": ["acsar", "husky"]}, "a fleet is for a batch of robots"),
        (POINT_GOAL, {"render_mode": "rgb_array", "view": "camera"}, "bullet"),
        (POINT_GOAL, {"randomization": True, "link": "replay:tape.mcap"}, "simulated"),
        (OBSTACLE_GOAL, {"link": "/dev/ttyUSB0"}, "like rplidar:///dev/ttyUSB1"),
    ],
)
def test_options_that_are_wrong_are_refused(
    env_id: str, options: dict[str, Any], message: str, make: Any
) -> None:
    with pytest.raises(AcsarError, match=message):
        make(env_id, **options).reset(seed=0)


@pytest.mark.parametrize(("view", "shape"), [("top", (480, 480, 3)), ("camera", (480, 640, 3))])
def test_render_draws_every_id(env_id: str, view: str, shape: tuple[int, ...], make: Any) -> None:
    env = make(env_id, "bullet", render_mode="rgb_array", view=view)
    env.reset(seed=0)
    first: Any = env.render()
    for _ in range(3):
        env.step(np.array([1.0, 0.5], np.float32))
    last: Any = env.render()
    assert first.dtype == np.uint8
    assert first.shape == last.shape == shape
    assert (first != last).any()


# Their specs

ROBOT = RobotConfig.preset("acsar").with_(max_linear=0.7, lidar={"rays": 33})
VALUES: dict[str, Any] = {
    "goal_distance": np.array([0.5, 2.0]),
    "goal_tolerance": np.float32(0.25),
    "randomization": Randomization(mass=(1, 2)),
    "weights": {"progress": np.float64(3.0)},
}


@pytest.mark.parametrize("options", [{}, VALUES])
def test_spec_goes_through_json(options: dict[str, Any], make: Any) -> None:
    env = make(POINT_GOAL, robot=ROBOT, faults=Faults(dropped_lines=0.01), **options)
    assert env.spec is not None
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec
    assert again.unwrapped.robot.config == env.unwrapped.robot.config == ROBOT
    assert vars(again.unwrapped.task) == vars(env.unwrapped.task)
    assert again.observation_space == env.observation_space
    assert repr(again.reset(seed=5)) == repr(env.reset(seed=5))


class Shaped(PointGoal):
    """A task with a function as an option."""

    def __init__(self, shape: Any = None) -> None:
        super().__init__()
        object.__setattr__(self, "shape", shape)


def test_spec_keeps_a_function_for_the_task() -> None:
    acsar_gym.register("mine/Shaped-v0", task=Shaped)
    env = gymnasium.make("mine/Shaped-v0", link="planar", shape=gymnasium.make)
    again: Any = gymnasium.make(env.spec or "")
    assert again.unwrapped.task.shape is gymnasium.make


def test_spec_of_a_batch_goes_through_json() -> None:
    batch: Any = make_vec(POINT_GOAL, 2, robot=ROBOT)
    assert EnvSpec.from_json(batch.spec.to_json()).kwargs["robot"] == ROBOT.model_dump(mode="json")


def test_reward_threshold_is_there_if_its_packaged_policy_solves_it(env_id: str) -> None:
    """Below what that policy reaches. No policy solves the ids with people."""
    threshold = gymnasium.spec(env_id).reward_threshold
    name = snake_case(env_id.removeprefix("acsar_gym/").partition("-")[0])
    has_policy = (AGENTS / "policies" / f"{name}.onnx").exists()
    assert (threshold is not None) == (has_policy and name not in ("crowd", "dyna_barn"))
