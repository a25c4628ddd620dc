"""Lost and late lines in a batch: the same lines as the single planar env loses, to 1e-9."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links.faults import Faults
from acsar_gym.registration import snake_case
from acsar_gym.sensors import Sensor

ACSAR = RobotConfig.preset("acsar")
MEASURED: dict[str, Any] = {
    "left_wheel_radius_multiplier": 0.98,
    "encoder": {"quantum": 0.1},
    "motor": {"acceleration": [60.0, 20.0, 33.0, 50.0]},
    "body": {"turn_factor": 1.8},
}
AT_ONCE: dict[str, Any] = {
    "linear_limits": {"max_acceleration": None},
    "angular_limits": {"max_acceleration": None},
}
FENCE: dict[str, Any] = {"max_x": 0.6, "min_y": -0.3, "max_y": 0.3}
DROPPED: dict[str, Any] = {"dropped_lines": 0.3}
LATE: dict[str, Any] = {"dropped_lines": 0.2, "late_lines": 0.2, "lateness": 0.033}
LONG: dict[str, Any] = {"late_lines": 0.05, "lateness": 0.2}
CASES: dict[str, tuple[dict[str, Any], RobotConfig]] = {
    "limits": (DROPPED, ACSAR),
    "no limits": (DROPPED, ACSAR.with_(**AT_ONCE)),
    "geofence": (DROPPED, ACSAR.with_(geofence=FENCE, feedback_timeout=0.2)),
    "slow feedback": (DROPPED, ACSAR.with_(firmware={"feedback_rate": 25.0})),
    "odd feedback": (LATE, ACSAR.with_(firmware={"feedback_rate": 30.0})),
    "fast feedback": (LATE, ACSAR.with_(firmware={"feedback_rate": 200.0})),
    "time-outs": ({"dropped_lines": 0.5}, ACSAR.with_(feedback_timeout=0.06)),
    "commands": (
        {"dropped_lines": 0.7, "direction": "commands"},
        ACSAR.with_(firmware={"command_timeout": 0.03}),
    ),
    "feedback": ({"dropped_lines": 0.7, "direction": "feedback"}, ACSAR),
    "some episodes": ({"dropped_lines": 0.7, "episodes": 0.5}, ACSAR),
    "a command delay": (DROPPED, ACSAR.with_(firmware={"command_delay": 0.0137}, **MEASURED)),
    "late with a command delay": (LATE, ACSAR.with_(firmware={"command_delay": 0.0371})),
    "late with a delay longer than a step": (
        LATE,
        ACSAR.with_(firmware={"command_delay": 0.1371}),
    ),
    "late on a slow wire": (LONG | {"direction": "commands"}, ACSAR.with_(baud_rate=38400)),
    "late and stale": (LONG | {"direction": "feedback"}, ACSAR.with_(feedback_timeout=0.15)),
    "half of 25 Hz": (
        {"dropped_lines": 0.5},
        ACSAR.with_(firmware={"feedback_rate": 25.0}, feedback_timeout=0.06),
    ),
}
VARIED = {"latency": (0.0, 0.03), "feedback_rate": (20.0, 60.0), "mass": (0.9, 1.1)}
SILENT = "silent in the reset"


class Single:
    """The planar env, whose reset may fail."""

    def __init__(self, env_id: str, arguments: dict[str, Any]) -> None:
        self._env = gymnasium.make(env_id, link="planar", disable_env_checker=True, **arguments)
        env: Any = self._env.unwrapped
        self.size = sum(sensor.size for sensor in env.sensors)
        self.told: Any = None
        self.over = False

    def reset(self, seed: int | None = None) -> None:
        try:
            observation, info = self._env.reset(seed=seed)
            self.told = observation, 0.0, False, False, info
        except LinkError:
            self.told = SILENT
        self.over = False

    def step(self, action: Any) -> None:
        """A step, or a reset where the episode is over; one that failed ends the next episode."""
        if self.over:
            self.reset()
        elif self.told is SILENT:
            self.over = True
        else:
            self.told = self._env.step(action)
            self.over = self.told[2] or self.told[3]

    def close(self) -> None:
        self._env.close()


def compare(kind: str, arguments: dict[str, Any], steps: int) -> dict[str, float]:
    """Every number of robot 1 against the single env; how often what happened."""
    env_id, arguments = full_id(snake_case(kind)), {"max_episode_steps": 60, **arguments}
    many: Any = gymnasium.make_vec(
        env_id, 3, vectorization_mode="vector_entry_point", threads=1, **arguments
    )
    one = Single(env_id, arguments)
    observations, info = many.reset(seed=40)
    rewards, ends, count = (
        np.zeros(3),
        np.zeros((2, 3)),
        dict.fromkeys(("cut", "failed", "stale"), 0.0),
    )
    one.reset(seed=41)
    rng = np.random.default_rng(0)
    for step in range(steps):
        if one.told is SILENT:
            count["failed"] += one.over
            assert not one.over or (rewards[1], *ends[:, 1], info["fault"][1]) == (0.0, 0, 1, 1.0)
        else:
            expected, reward, *end, told = one.told
            assert observations[1] == pytest.approx(expected, abs=1e-6)  # float32
            assert (rewards[1], *ends[:, 1]) == (pytest.approx(float(reward), abs=1e-9), *end)
            told.pop("fault_reason", None)
            assert {key: info[key][1] for key in told} == pytest.approx(told, abs=1e-9, nan_ok=True)
            count["cut"] += told["fault"] == 1.0
            count["stale"] += told["sent_reason"] == 3.0
        actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        actions[:, 0] = abs(actions[:, 0])
        actions *= step % 17 != 0
        observations, rewards, *both, info = many.step(actions)
        ends = np.array(both)
        one.step(actions[1])
    many.close()
    one.close()
    return count


@pytest.mark.parametrize("name", CASES)
def test_the_same_lines_are_lost(name: str) -> None:
    faults, robot = CASES[name]
    count = compare("PointGoal", {"robot": robot, "faults": faults}, 150)
    assert (count["cut"] > 0) == (name in {"time-outs", "late and stale", "half of 25 Hz"})
    assert (count["failed"] > 0) >= (name == "half of 25 Hz")
    assert (count["stale"] > 0) >= (name in {"time-outs", "late and stale"})


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("ObstacleGoal", {"worlds": "clutter:6", "randomization": VARIED}),
        ("ObstacleGoal", {"worlds": "clutter:6", "faults": {"dropped_lines": 0.5}}),
        ("PathFollow", {"worlds": "smooth_path:6"}),
    ],
    ids=["randomized", "noise of scans goes on after a cut", "path"],
)
def test_the_same_lines_are_lost_with_every_task(kind: str, more: dict[str, Any]) -> None:
    timeout = 0.3 if "randomization" in more else 0.06
    more = {"faults": LATE, "robot": ACSAR.with_(feedback_timeout=timeout)} | more
    compare(kind, more, 150)


def test_a_long_drive_through_limits_fence_and_lost_lines() -> None:
    robot = ACSAR.with_(geofence={"max_x": 1.5, "min_y": -1.0, "max_y": 1.0}, feedback_timeout=0.15)
    compare("PointGoal", {"robot": robot, "faults": DROPPED | {"late_lines": 0.1}}, 1000)


class Noise(Sensor):
    """Draws at its reset, and when it is read."""

    name, size = "noise", 1

    def reset(self, scene: Any, rng: Any) -> None:
        super().reset(scene, rng)
        self.bias = rng.normal()

    def read(self, truth: Any, now: float) -> Any:
        return [self.bias + self.rng.normal()]


@pytest.mark.parametrize("sensors", [("lidar",), (Noise,)], ids=["LiDAR", "in Python"])
def test_generators_stay_those_of_the_single_env_after_a_silent_reset(sensors: Any) -> None:
    robot = ACSAR.with_(firmware={"feedback_rate": 25.0}, feedback_timeout=0.08)
    arguments = {"robot": robot, "faults": {"dropped_lines": 0.5}, "sensors": sensors}
    many = batch(autoreset_mode="Disabled", **arguments)
    first, _ = many.reset(seed=0)
    again, info = many.reset(options={"reset_mask": np.ones(40, np.bool_)})
    compared = 0
    for i in range(40):
        one = Single("acsar_gym/PointGoal-v0", arguments)
        one.reset(seed=i)
        failed = one.told is SILENT
        assert not failed or (first[i, -one.size :] == 0.0).all()
        one.reset()
        if failed and one.told is not SILENT:
            assert again[i] == pytest.approx(one.told[0], abs=1e-6)
            assert info["true_goal_distance"][i] == one.told[4]["true_goal_distance"]
            compared += 1
        one.close()
    assert compared > 0
    many.close()


def batch(**arguments: Any) -> Any:
    return gymnasium.make_vec(
        "acsar_gym/PointGoal-v0", 40, vectorization_mode="vector_entry_point", **arguments
    )


def test_what_is_told_of_a_silent_robot_is_what_it_was_told_last() -> None:
    robot = ACSAR.with_(feedback_timeout=0.06)
    env = batch(robot=robot, faults={"dropped_lines": 0.5}, autoreset_mode="SameStep")
    before, told = env.reset(seed=0)
    cut = np.zeros(40, np.bool_)
    for _ in range(20):
        after, rewards, terminated, truncated, info = env.step(np.full((40, 2), 0.5))
        cut = truncated
        if cut.any():
            break
        before, told = after, info
    final, last = info["final_obs"], info["final_info"]
    assert not (terminated & cut).any()
    assert (rewards[cut] == 0.0).all()
    assert (last["fault"] == cut).all()
    for robot_number in np.flatnonzero(cut):
        assert (final[robot_number] == before[robot_number]).all()
        for key in ("odom_x", "true_x", "true_theta", "feedback_age", "sent_linear"):
            assert last[key][robot_number] == told[key][robot_number]
    assert (info["fault"] == 0.0).all()
    assert (last["episode_length"][cut] >= 1).all()
    env.close()


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"unplug_rate": 0.1}, "unplug_rate: a batch knows dropped_lines, late_lines"),
        ({"cut_lines": 0.1}, "vectorization_mode='sync'"),
        (Faults(stuck_encoders="a"), "stuck_encoders: a batch knows"),
        ({"droped_lines": 0.1}, "did you mean 'dropped_lines'"),
        ({"dropped_lines": 1.1}, "dropped_lines = 1.1"),
        ({"late_lines": 0.1, "lateness": 50.0}, "lateness = 50: must be at most 19.3 s"),
    ],
)
def test_faults_that_a_batch_does_not_know_are_one_clear_error(faults: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        batch(faults=faults)


def test_faults_that_cannot_happen_change_nothing() -> None:
    plain, none = batch(), batch(faults={"dropped_lines": 0.5, "episodes": 0.0})
    assert (plain.reset(seed=0)[0] == none.reset(seed=0)[0]).all()
    assert "fault" not in none.step(np.zeros((40, 2)))[4]
    plain.close()
    none.close()
