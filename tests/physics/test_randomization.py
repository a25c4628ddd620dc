"""What episodes draw, and what it does to a robot's physics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scenes import RANGES

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.physics import Physics, Randomization, compute_physics
from acsar_gym.physics.randomization import (
    TABLE,
    Randomizer,
    describe_ranges,
    randomization_level,
)

CONFIG = RobotConfig()
ACSAR = RobotConfig.preset("acsar")


def draw(ranges: Any) -> tuple[Physics, dict[str, Any]]:
    randomizer = Randomizer(ranges, CONFIG, 0.1, simulated=True)
    physics = randomizer.draw(np.random.default_rng(0))
    assert physics is not None
    return physics, randomizer.info()


@pytest.mark.parametrize("name", Randomization.model_fields)
def test_randomizer_changes_only_the_numbers_of_each_parameter(name: str) -> None:
    physics, info = draw({name: RANGES[name]})
    pairs = zip(Physics._fields, physics, compute_physics(CONFIG), strict=True)
    changed = {field.removesuffix("_a") for field, number, usual in pairs if number != usual}
    assert {field for field in changed if field[-2:] not in ("_b", "_c", "_d")} == {
        *TABLE[name].changes
    }
    assert list(info) == [f"drawn_{name}"]
    values = np.array(info[f"drawn_{name}"])
    assert (values >= min(RANGES[name])).all()
    assert (values <= max(RANGES[name]) * 1.12).all()  # 60 Hz are rounded to 66.7


def test_randomizer_without_ranges_keeps_the_configured_robot() -> None:
    assert Randomizer(None, CONFIG, 0.1, simulated=False).draw(np.random.default_rng(0)) is None
    assert draw({"mass": (1.0, 1.0)})[0] == compute_physics(CONFIG)


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"frictoin": (0.5, 1.0)}, "did you mean 'friction'"),
        ({"latency": (0.0, 0.099)}, r"latency = .*: on this wire a line takes up to 0.119 s"),
        ({"feedback_rate": (20.0, 190.0)}, "feedback_rate = .*baud_rate = 19200"),
        ({"mass": (2.0, 1.0)}, "mass = .*low <= high"),
    ],
)
def test_randomization_refuses_bad_ranges(ranges: Any, message: str) -> None:
    config = CONFIG.with_(baud_rate=19200, control_rate=50.0)
    with pytest.raises(ConfigError, match=f"randomization.*{message}"):
        Randomization.of(ranges).ranges(config, 0.1)


def between(low: float, high: float) -> dict[str, Any]:
    return {"low": low, "high": high, "method": "identify"}


FITTED = ACSAR.with_(
    motor={"time_constant": [0.1, 0.1, 0.2, 0.1], "gain": 0.98, "deadband": [0.2, 0.3, 0.2, 0.2]},
    body={"turn_factor": 1.7},
    firmware={"command_delay": 0.008},
    measured={
        "motor.time_constant.a": between(0.098, 0.103),
        "motor.time_constant.b": between(0.099, 0.101),
        "motor.time_constant.c": between(0.19, 0.21),
        "motor.time_constant.d": between(0.099, 0.102),
        "motor.deadband.a": between(0.15, 0.22),
        "motor.deadband.b": between(0.28, 0.36),
        "firmware.command_delay": between(0.006, 0.011),
        "wheel_radius": between(0.0498, 0.0501),
        "body.turn_factor": between(1.6, 1.76),
    },
)


def test_measured_randomization_has_the_measured_intervals() -> None:
    ranges = Randomization.measured(FITTED)
    assert ranges.motor_lag == pytest.approx((0.95, 1.05))
    assert ranges.deadband_offset == pytest.approx((-0.05, 0.06))
    assert ranges.command_delay == (0.006, 0.011)
    assert ranges.wheel_radius == pytest.approx((0.996, 1.002))
    assert ranges.turn_factor == pytest.approx((1.6 / 1.7, 1.76 / 1.7))
    assert ranges.friction == TABLE["friction"].default
    assert ranges.latency is None
    line = describe_ranges(FITTED)
    assert "motor_lag 0.95 to 1.05" in line
    assert line.endswith("by default widths: friction, motor_gain")


def test_measured_randomization_replays_delays() -> None:
    delays = (0.001, 0.004, 0.0125)
    config = ACSAR.with_(firmware={"delay_samples": delays, "command_delay": 0.003})
    ranges = Randomization.measured(config)
    assert (ranges.delay_samples, ranges.latency) == (delays, None)
    randomizer = Randomizer(ranges, config, 0.1, simulated=True)
    rng = np.random.default_rng(0)
    episodes = [randomizer.draw(rng) for _ in range(50)]
    assert {physics.command_delay for physics in episodes if physics} == {
        0.003 + delay for delay in delays
    }


def test_randomization_level_contains_the_level_below() -> None:
    levels = [randomization_level(ACSAR, number) for number in (1, 2, 3)]
    for name in levels[0].names:
        narrow, usual, wide = (getattr(level, name) for level in levels)
        assert wide[0] <= usual[0] <= narrow[0] <= narrow[1] < usual[1] < wide[1]
    assert levels[2].latency == (0.0, 0.04)
    assert levels[2].friction == pytest.approx((0.4, 1.4))
