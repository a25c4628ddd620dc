"""Policies that are trained with measured ranges drive robots that they have never met."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.envs import ids
from acsar_gym.physics import Randomization
from acsar_gym.tools.policies.onnx import OnnxPolicy
from acsar_gym.tools.training import held_out, seeds

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group(__name__)]

ROBOTS = 50
LEAST = 0.97
"""Share of the nominal success that other robots must reach."""
LAG, GAIN, DEADBAND = (0.112, 0.118, 0.109, 0.121), (0.98, 1.01, 1.0, 0.97), (0.3, 0.35, 0.25, 0.3)
TRUTH = RobotConfig.preset("acsar").with_(
    wheel_separation_multiplier=1.72,
    left_wheel_radius_multiplier=0.985,
    right_wheel_radius_multiplier=1.005,
    motor={"time_constant": LAG, "gain": GAIN, "deadband": DEADBAND},
    encoder={"quantum": 0.05},
    firmware={"feedback_rate": 50.0, "command_delay": 0.008},
    body={"turn_factor": 1.72},
)
"""What no training sees."""
WIDTHS = {"time_constant": 0.05, "gain": 0.01, "turn_factor": 0.02, "radius": 0.003}
"""Relative errors of the measurements, as of identification and calibration."""
DEADBAND_WIDTH, DELAY_WIDTH = 0.05, 0.004


def around(value: float, width: float) -> dict[str, Any]:
    return {"low": value - width, "high": value + width, "method": "test"}


def fitted(rng: np.random.Generator) -> RobotConfig:
    """The robot as it was measured: values with an error, and intervals that hold the truth."""
    motor, intervals = {}, {}
    for field, true in (("time_constant", LAG), ("gain", GAIN), ("deadband", DEADBAND)):
        widths = [DEADBAND_WIDTH if field == "deadband" else WIDTHS[field] * one for one in true]
        found = [
            one + width * rng.uniform(-0.7, 0.7) for one, width in zip(true, widths, strict=True)
        ]
        motor[field] = found
        for wheel, one, width in zip("abcd", found, widths, strict=True):
            intervals[f"motor.{field}.{wheel}"] = around(one, width)
    factor = 1.72 * (1.0 + WIDTHS["turn_factor"] * rng.uniform(-0.7, 0.7))
    delay = 0.008 + DELAY_WIDTH * rng.uniform(-0.7, 0.7)
    intervals["body.turn_factor"] = around(factor, factor * WIDTHS["turn_factor"])
    intervals["firmware.command_delay"] = around(delay, DELAY_WIDTH)
    intervals["wheel_radius"] = around(0.05, 0.05 * WIDTHS["radius"])
    return TRUTH.with_(
        wheel_separation_multiplier=factor,
        motor=motor,
        firmware={"command_delay": delay},
        body={"turn_factor": factor},
        measured=intervals,
    )


def other(robot: RobotConfig, rng: np.random.Generator) -> tuple[RobotConfig, Randomization]:
    """A robot drawn around the truth that is driven by the measured one's driver.

    Driver and twin share the radii, so those of the drawn robot are ranges of one value.
    """

    def drawn(values: tuple[float, ...], width: float) -> list[float]:
        return [value * (1.0 + width * rng.uniform(-1.0, 1.0)) for value in values]

    config = robot.with_(
        motor={
            "time_constant": drawn(LAG, WIDTHS["time_constant"]),
            "gain": drawn(GAIN, WIDTHS["gain"]),
            "deadband": [one + DEADBAND_WIDTH * rng.uniform(-1.0, 1.0) for one in DEADBAND],
        },
        firmware={"command_delay": 0.008 + DELAY_WIDTH * rng.uniform(-1.0, 1.0)},
        body={
            "turn_factor": drawn((1.72,), WIDTHS["turn_factor"])[0],
            "friction": rng.uniform(0.8, 1.1),
        },
    )
    left, right = drawn((1.0, 1.0), WIDTHS["radius"])
    radii = Randomization(left_wheel_radius=(left, left), right_wheel_radius=(right, right))
    return config, radii


def success(env_id: str, policy: OnnxPolicy, robot: RobotConfig, own: Randomization) -> float:
    """Share of 64 held-out episodes that succeed."""
    worlds = {} if "PointGoal" in env_id else {"worlds": "clutter:900-963"}
    batch = ids.make_vec(
        env_id, held_out.HELD_OUT_ROBOTS, robot=robot, randomization=own, threads=1, **worlds
    )
    score = held_out.evaluate_held_out(batch, lambda seen: np.array([policy(row) for row in seen]))
    batch.close()
    return score.success_rate


@pytest.mark.parametrize("name", ["point_goal", "obstacle_goal"])
def test_a_policy_trained_with_measured_ranges_drives_fifty_robots(
    name: str, tmp_path: Path
) -> None:
    """At least 97 % of the nominal success, with the mean over robots drawn around the truth."""
    rng = np.random.default_rng(11)
    robot = fitted(rng)
    robot.save(tmp_path / "robot.yaml")
    options = ["--env", name, "--robot", str(tmp_path / "robot.yaml"), "--out", str(tmp_path)]
    assert seeds.main([*options, "--no-progress"]) == 0
    policy = OnnxPolicy(tmp_path / "policy.onnx")
    nominal = success(policy.env_id, policy, robot, Randomization())
    rates = [success(policy.env_id, policy, *other(robot, rng)) for _ in range(ROBOTS)]
    mean = float(np.mean(rates))
    print(
        f"{name}: nominal {nominal:.1%}, mean of {ROBOTS} robots {mean:.1%}, least {min(rates):.1%}"
    )
    assert nominal >= 0.7
    assert mean >= LEAST * nominal
