"""What episodes draw, and what it does to a robot's physics."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from varied import RANGES

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.physics import Physics, Randomization, compute_physics
from acsar_gym.physics.model import loop_period
from acsar_gym.physics.randomization import (
    DEFAULT_RANGES,
    Drawn,
    Randomizer,
    describe_ranges,
    drawn_places,
    randomization_level,
    vary_physics,
)

CONFIG = RobotConfig()
DT, STEP = loop_period(CONFIG), 0.1
WHEELS = "abcd"
CHANGES = {
    "mass": {"mass", "yaw_inertia", "grip"},
    "friction": {"grip"},
    "motor_gain": {f"gain_{wheel}" for wheel in WHEELS},
    "motor_lag": {f"blend_{wheel}" for wheel in WHEELS},
    "deadband": {f"deadband_{wheel}" for wheel in WHEELS},
    "wheel_radius": {"left_radius", "right_radius"},
    "latency": {"latency_loops"},
    "feedback_rate": {"feedback_loops"},
    "track_width": {"half_track"},
    "left_wheel_radius": {"left_radius"},
    "right_wheel_radius": {"right_radius"},
    "turn_factor": {"kappa"},
    "command_delay": {"command_delay"},
    "delay_samples": {"command_delay"},
    "deadband_offset": {f"deadband_{wheel}" for wheel in WHEELS},
    "lidar_rate": {"scan_rate"},
    "lidar_noise": {"range_noise"},
    "lidar_bias": {"range_bias"},
    "lidar_dropouts": {"range_dropouts"},
    "lidar_outliers": {"range_outliers"},
}


def drawn(ranges: Any, seed: int = 0, config: RobotConfig = CONFIG) -> tuple[Physics, Any]:
    randomizer = Randomizer(ranges, config, STEP, simulated=True)
    own = randomizer.draw(np.random.default_rng(seed))
    assert own is not None
    return own, randomizer.info()


def wheels(own: Physics, name: str) -> list[float]:
    """The four numbers of a robot's wheels."""
    return [getattr(own, f"{name}_{wheel}") for wheel in WHEELS]


def test_every_parameter_has_numbers_and_every_number_a_parameter() -> None:
    names = list(Randomization.model_fields)
    assert sorted(place for name in names for place in drawn_places(name)) == list(
        range(len(Drawn()))
    )
    assert set(RANGES) == set(CHANGES) == set(names)


def test_the_defaults_leave_a_robot_as_configured() -> None:
    assert vary_physics(compute_physics(CONFIG), Drawn(), DT) == compute_physics(CONFIG)
    assert Randomizer(None, CONFIG, STEP, simulated=False).draw(np.random.default_rng(0)) is None


@pytest.mark.parametrize("name", RANGES)
def test_each_parameter_changes_its_own_numbers_alone(name: str) -> None:
    own, info = drawn({name: RANGES[name]})
    pairs = zip(Physics._fields, own, compute_physics(CONFIG), strict=True)
    assert {field for field, number, configured in pairs if number != configured} == CHANGES[name]
    assert list(info) == [f"drawn_{name}"]
    values = np.array(info[f"drawn_{name}"])
    assert (values >= min(RANGES[name])).all()
    assert (values <= max(RANGES[name]) * 1.12).all()  # 60 Hz are rounded to 66.7


def test_factors_multiply_and_the_others_replace() -> None:
    own, info = drawn(RANGES)
    configured = compute_physics(CONFIG)
    assert own.mass == pytest.approx(configured.mass * info["drawn_mass"])
    assert own.yaw_inertia == pytest.approx(configured.yaw_inertia * info["drawn_mass"])
    grip = configured.grip * info["drawn_mass"] * info["drawn_friction"]
    assert own.grip == pytest.approx(grip)
    assert wheels(own, "gain") == pytest.approx(info["drawn_motor_gain"])
    lag = -DT / np.log(1.0 - np.array(wheels(own, "blend")))
    assert lag == pytest.approx(CONFIG.motor.time_constant * info["drawn_motor_lag"])
    dead = info["drawn_deadband"] + info["drawn_deadband_offset"]
    assert wheels(own, "deadband") == pytest.approx(dead)
    for side in ("left", "right"):
        factor = info["drawn_wheel_radius"] * info[f"drawn_{side}_wheel_radius"]
        assert getattr(own, f"{side}_radius") == pytest.approx(0.05 * factor)
    ratio = (CONFIG.wheelbase / CONFIG.wheel_separation) ** 2
    assert 1.0 + own.kappa * ratio == pytest.approx((1.0 + ratio) * info["drawn_turn_factor"])
    delay = info["drawn_command_delay"] + info["drawn_delay_samples"]
    assert own.command_delay == pytest.approx(delay)


@pytest.mark.parametrize(
    ("ranges", "field"),
    [
        ({"frictoin": (0.5, 1.0)}, "did you mean 'friction'"),
        ({"mass": (2.0, 1.0)}, "mass"),
        ({"latency": (-0.1, 0.1)}, "latency"),
        ({"latency": (0.0, 0.099)}, r"latency = .*: on this wire a line takes up to 0.119 s"),
        ({"turn_factor": (0.6, 1.0)}, r"turn_factor = .*0\.92"),
        ({"command_delay": (0.0, 1.5)}, "command_delay"),
        ({"feedback_rate": (1.0, 20.0)}, "feedback_rate = .*feedback_timeout = 0.5 s"),
        ({"feedback_rate": (20.0, 190.0)}, "feedback_rate = .*baud_rate = 19200"),
    ],
)
def test_bad_ranges_are_one_clear_error(ranges: Any, field: str) -> None:
    config = CONFIG.with_(baud_rate=19200, control_rate=50.0)
    with pytest.raises(ConfigError, match=rf"^(unknown field ')?randomization.*{field}") as raised:
        Randomization.of(ranges).ranges(config, STEP)
    assert "\n" not in str(raised.value)


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


def test_levels_are_nested() -> None:
    narrow, usual, wide = (randomization_level(ACSAR, number) for number in (1, 2, 3))
    for name in usual.names:
        ends = [getattr(each, name) for each in (narrow, usual, wide)]
        assert ends[2][0] <= ends[1][0] <= ends[0][0] <= ends[0][1] < ends[1][1] < ends[2][1]
    assert wide.latency == (0.0, 0.04)
    assert wide.friction == pytest.approx((0.4, 1.4))
