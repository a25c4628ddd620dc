"""A robot's parameters: defaults, derived values, rates, wiring, and errors that name the field."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.config import (
    EncoderConfig,
    FirmwareConfig,
    Measured,
    MotorConfig,
    update_measured,
)
from acsar_gym.errors import ConfigError
from acsar_gym.protocol import Speeds


def refusal(make: Callable[..., Any], values: Mapping[str, Any]) -> str:
    """The message of the one ConfigError that these values raise."""
    with pytest.raises(ConfigError) as caught:
        make(**values)
    message = str(caught.value)
    assert "\n" not in message
    return message


POSITIVE = (
    (RobotConfig, "wheel_radius"),
    (MotorConfig, "gain"),
    (EncoderConfig, "counts_per_revolution"),
    (FirmwareConfig, "command_timeout"),
)
BAD_NUMBERS = [0, -1, math.nan, math.inf, "fast", [1]]
INTERVAL = {"low": 0.09, "high": 0.11, "method": "identify"}


def test_config_equal_configs_are_one_key_and_survive_pickling() -> None:
    config = RobotConfig(wheel_radius=0.1, motor={"max_speed": 20})
    same = RobotConfig(wheel_radius=0.1, motor=MotorConfig(max_speed=20))
    assert {config, same} == {config}
    assert config != RobotConfig()
    assert pickle.loads(pickle.dumps(config)) == config  # noqa: S301 - our own bytes


@pytest.mark.parametrize(("model", "field"), POSITIVE)
def test_config_names_field_and_value(model: type[Any], field: str) -> None:
    named = f"{model.section}.{field}" if model.section else field
    for bad in BAD_NUMBERS:
        assert refusal(model, {field: bad}).startswith(f"{named} = {bad!r}: must be")


BAD: list[tuple[dict[str, Any], str]] = [
    ({"wheel_radius": 6}, "wheel_radius = 6: must be less than or equal to 1"),
    ({"baud_rate": 4800}, "baud_rate = 4800: must be one of 9600, 19200"),
    ({"encoder": {"window": 0.004}}, "encoder.window = 0.004 s"),
    ({"wheels": {"b": {"motor": "d"}}}, "wheels: motor d belongs to 2 wheels"),
    ({"wheels": {"e": {}}}, "unknown field 'wheels.e'"),
    ({"ros2": {"joints": ["r", "l", "r", "l"]}}, "ros2.joints = ['r', 'l', 'r', 'l']: must name"),
    ({"ros2": {"scan_topic": "/scan/"}}, "ros2.scan_topic = '/scan/': must be a topic, such as"),
    ({"port": "COM3"}, "unknown field 'port'; did you mean 'serial_port'?"),
    ({"wheel_base": 0.3}, "unknown field 'wheel_base'; write wheel_separation for the distance"),
    ({"linear_limits": {"max_acceleration": 0.0}}, "linear_limits.max_acceleration = 0.0: must be"),
    ({"control_rate": 30}, "firmware.loop_rate = 200 Hz"),
    ({"firmware": {"feedback_rate": 2}}, "feedback_timeout = 0.5 s"),
    ({"measured": {"motor.tiem_constant": INTERVAL}}, "measured: unknown field 'motor.tiem_cons"),
]


@pytest.mark.parametrize(("values", "named"), BAD)
def test_config_bad_values_are_one_error_that_names_the_field(
    values: dict[str, Any], named: str
) -> None:
    for make in (RobotConfig, RobotConfig().with_):
        assert refusal(make, values).startswith(named)


@pytest.mark.parametrize("field", ["gain", "deadband"])
def test_motor_values_are_one_number_or_four(field: str) -> None:
    equal = RobotConfig(motor={field: 2})
    assert [getattr(equal.motor.of_wheel(wheel), field) for wheel in range(4)] == [2.0] * 4
    four = RobotConfig(motor={field: [1, "2", 3.0, 4]})
    assert [getattr(four.motor.of_wheel(wheel), field) for wheel in range(4)] == [1, 2, 3, 4]
    assert RobotConfig(**four.model_dump(mode="json")) == four
    message = refusal(RobotConfig, {"motor": {field: [1.0, 2.0, -3.0, 4.0]}})
    assert message.startswith(f"motor.{field} = -3.0: must be greater than")


@pytest.mark.parametrize(
    ("joints", "expected"),
    [
        (["fr", "fl", "rl", "rr"], ("fr", "fl", "rl", "rr")),
        ({"b": "fr", "c": "fl", "d": "rl", "a": "rr"}, ("rr", "fr", "fl", "rl")),
        ({"left": "l", "right": "r"}, ("r", "l", "l", "r")),
    ],
)
def test_ros2_joints_are_named_in_three_ways(joints: Any, expected: Any, tmp_path: Path) -> None:
    config = RobotConfig(ros2={"joints": joints, "command_joints": sorted({*expected})})
    assert config.ros_joints == expected
    assert config.has_two_wheels == ("left" in joints)
    if config.has_two_wheels:
        with pytest.raises(ConfigError, match=r"two driven wheels \(r, l\): .*--link ros2 drives"):
            config.check_simulated()
    else:
        config.check_simulated()

    assert RobotConfig(**config.model_dump(mode="json")) == config
    assert len({config, config.with_(ros2={"command_joints": None})}) == 2
    file = tmp_path / "mine.yaml"
    config.save(file)
    assert RobotConfig.load(file) == config


def test_with_changes_a_validated_copy_and_keeps_the_rest() -> None:
    config = RobotConfig(wheelbase=0.25, motor={"max_speed": 20})
    changed = config.with_(wheel_radius=0.1, encoder={"window": 0.1})
    assert (changed.wheel_radius, changed.encoder.window) == (0.1, 0.1)
    assert (changed.wheelbase, changed.motor) == (0.25, config.motor)
    assert (config.wheel_radius, config.encoder) == (0.05, EncoderConfig())
    assert config.with_() == config


def test_of_takes_a_config_a_file_a_preset_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("wheel_radius: 0.07\n")
    config = RobotConfig(wheel_radius=0.07)
    assert RobotConfig.of(config) is config
    assert RobotConfig.of(path) == RobotConfig.of(str(path)) == config
    assert RobotConfig.of(None) == RobotConfig.of("acsar") == RobotConfig.preset("acsar")
    with pytest.raises(ConfigError, match="did you mean 'acsar'"):
        RobotConfig.of("acsr")


@pytest.mark.parametrize(("baud", "lines"), [(9600, 28), (115200, 338)])
@pytest.mark.parametrize("name", ["control_rate", "firmware.feedback_rate"])
def test_baud_rate_must_fit_the_lines(name: str, baud: int, lines: int) -> None:
    def at(rate: int) -> dict[str, Any]:
        control_rate = rate if name == "control_rate" else 1
        firmware = {"loop_rate": rate, "feedback_rate": rate if control_rate == 1 else None}
        return {"baud_rate": baud, "control_rate": control_rate, "firmware": firmware}

    assert RobotConfig(**at(lines)).feedback_rate == lines
    message = refusal(RobotConfig, at(lines + 1))
    assert message.startswith(f"baud_rate = {baud}: carries {lines} lines of 34 bytes a second")
    assert f"{name} needs {lines + 1}" in message


def test_update_measured_of_all_wheels_ends_those_of_single_ones_and_the_reverse() -> None:
    old, new = (Measured(low=1.0, high=2.0, method=name) for name in ("old", "new"))
    single = {"motor.gain.a": old, "motor.gain.c": old, "motor.deadband.a": old}
    every = {"motor.gain": new, "motor.deadband.a": old}
    assert update_measured(single, {"motor.gain": new}) == every
    others_new = {f"motor.gain.{wheel}": new for wheel in "abd"}
    expected = {"motor.gain.c": old, **others_new, "motor.deadband.a": old}
    assert update_measured(every, {"motor.gain.c": old}) == expected


MIXED = {
    "a": {"motor": "b", "encoder": "c", "sign": -1},
    "b": {"motor": "a", "motor_sign": -1, "encoder": "d"},
    "c": {"motor": "d", "encoder": "a"},
    "d": {"motor": "c", "encoder": "b", "motor_sign": -1, "sign": -1},
}
"""Letters and signs of both directions differ."""


def driven(config: RobotConfig) -> tuple[list[Speeds], tuple[float, float, float]]:
    """Wheel speeds and true pose of a robot that drives an arc."""
    with Robot(open_link("planar", config), config) as robot:
        speeds = []
        for _ in range(100):
            robot.drive(0.3, 0.5)
            speeds.append(robot.speeds)
        assert robot.link.truth is not None
        return speeds, robot.link.truth.pose


@pytest.mark.parametrize("wheels", [{"a": {"encoder": "b"}, "b": {"encoder": "a"}}, MIXED])
def test_wheels_board_and_driver_agree_with_any_wiring(wheels: dict[str, Any]) -> None:
    assert driven(RobotConfig(wheels=wheels)) == driven(RobotConfig())


@pytest.mark.parametrize("axis", ["linear_limits", "angular_limits"])
def test_limits_what_ros_calls_no_limit_is_none(axis: str) -> None:
    unset = {"max_jerk": 0.0, "min_jerk": math.nan, "max_acceleration": math.nan}
    limits = getattr(RobotConfig(**{axis: unset}), axis)
    assert limits.model_dump(exclude_none=True) == {}
