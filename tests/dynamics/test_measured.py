"""Randomization from what was measured of a robot."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.physics import Randomization
from acsar_gym.physics.model import turn_factor
from acsar_gym.physics.randomization import DEFAULT_RANGES, Randomizer, describe_ranges

ACSAR = RobotConfig.preset("acsar")
MOTOR = {"time_constant": [0.1, 0.1, 0.2, 0.1], "gain": 0.98, "deadband": [0.2, 0.3, 0.2, 0.2]}


def between(low: float, high: float) -> dict[str, Any]:
    return {"low": low, "high": high, "method": "identify"}


FOUND = {
    "motor.time_constant.a": between(0.098, 0.103),
    "motor.time_constant.b": between(0.099, 0.101),
    "motor.time_constant.c": between(0.19, 0.21),
    "motor.time_constant.d": between(0.099, 0.102),
    "motor.gain": between(0.9702, 0.98),
    "motor.deadband.a": between(0.15, 0.22),
    "motor.deadband.b": between(0.28, 0.36),
    "firmware.command_delay": between(0.006, 0.011),
    "wheel_radius": between(0.0498, 0.0501),
    "left_wheel_radius_multiplier": between(0.999, 1.003),
    "body.turn_factor": between(1.6, 1.76),
}
FITTED = ACSAR.with_(
    motor=MOTOR, body={"turn_factor": 1.7}, firmware={"command_delay": 0.008}, measured=FOUND
)


def test_without_measurements_the_default_widths_are_used() -> None:
    assert Randomization.measured(ACSAR) == Randomization.of(DEFAULT_RANGES)
    assert describe_ranges(ACSAR) == ""


def test_measured_intervals_become_ranges() -> None:
    ranges = Randomization.measured(FITTED)
    assert ranges.motor_lag == pytest.approx((0.95, 1.05))
    assert ranges.motor_gain == pytest.approx((0.99, 1.0))
    assert ranges.deadband_offset == pytest.approx((-0.05, 0.06))
    assert ranges.command_delay == (0.006, 0.011)
    assert ranges.wheel_radius == pytest.approx((0.996, 1.002))
    assert ranges.left_wheel_radius == (0.999, 1.003)
    assert ranges.turn_factor == pytest.approx((1.6 / 1.7, 1.76 / 1.7))
    assert (ranges.friction, ranges.latency) == (DEFAULT_RANGES["friction"], None)
    line = describe_ranges(FITTED)
    assert "randomized as measured: " in line
    assert "motor_lag 0.95 to 1.05" in line
    assert line.endswith("by default widths: friction")


def test_wheels_that_were_not_measured_have_the_default_width() -> None:
    own = ACSAR.with_(measured={"motor.time_constant.a": between(0.0796, 0.0804)})
    assert Randomization.measured(own).motor_lag == pytest.approx(DEFAULT_RANGES["motor_lag"])


def test_a_calibrated_multiplier_is_a_turn_factor() -> None:
    found = {"wheel_separation_multiplier": between(1.7, 1.8)}
    own = ACSAR.with_(wheel_separation_multiplier=1.75, measured=found)
    factor = 1.0 + (0.22 / 0.3) ** 2
    assert Randomization.measured(own).turn_factor == pytest.approx((1.7 / factor, 1.8 / factor))


def test_default_widths_suit_robots_that_hardly_skid() -> None:
    short = RobotConfig(wheel_separation=0.6, wheelbase=0.06)
    Randomization.measured(short).ranges(short, 0.1)


def test_measured_delays_are_replayed_in_single_envs_and_batches() -> None:
    delays = (0.001, 0.004, 0.0125)
    own = ACSAR.with_(firmware={"delay_samples": delays, "command_delay": 0.003})
    ranges = Randomization.measured(own)
    assert (ranges.delay_samples, ranges.latency) == (delays, None)
    randomizer, rng = Randomizer(ranges, own, 0.1, simulated=True), np.random.default_rng(0)
    drawn = [randomizer.draw(rng) for _ in range(50)]
    assert {one.command_delay for one in drawn if one} == {0.003 + delay for delay in delays}
    many: Any = gymnasium.make_vec(
        "acsar_gym/PointGoal-v0",
        50,
        vectorization_mode="vector_entry_point",
        robot=own,
        randomization=ranges,
    )
    info = many.reset(seed=0)[1]
    assert set(info["drawn_delay_samples"].tolist()) == set(delays)
    many.close()


@pytest.mark.parametrize(
    ("name", "interval", "parameter"),
    [
        ("wheel_separation_multiplier", between(0.9, 1.0), "turn_factor"),
        ("wheel_separation_multiplier", between(0.95, 1.05), "turn_factor"),
        ("body.turn_factor", between(1.0001, 1.1), "turn_factor"),
        ("motor.time_constant", between(0.0, 0.16), "motor_lag"),
        ("firmware.command_delay", between(0.115, 0.125), "command_delay"),
    ],
)
def test_any_interval_of_a_robot_can_be_trained_with(
    name: str, interval: dict[str, Any], parameter: str
) -> None:
    own = ACSAR.with_(measured={name: interval})
    ranges = Randomization.measured(own)
    ranges.ranges(own, 0.1)
    low, high = getattr(ranges, parameter)
    assert low <= high
    if parameter == "turn_factor":
        assert low * turn_factor(own) == pytest.approx(1.001, abs=1e-9)
