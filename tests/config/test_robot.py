"""A robot's parameters: defaults, derived values, and errors that name what is wrong."""

from __future__ import annotations

import math
import pickle
import re
from pathlib import Path
from typing import Any

import pytest
from config_tools import config_of, refusal
from pydantic import ValidationError

from acsar_gym import RobotConfig
from acsar_gym.config import BodyConfig, EncoderConfig, FirmwareConfig, MotorConfig
from acsar_gym.errors import ConfigError

POSITIVE: list[tuple[type[Any], str]] = [
    *((RobotConfig, name) for name in ("wheel_radius", "wheel_separation", "wheelbase")),
    *((RobotConfig, name) for name in ("wheel_separation_multiplier", "control_rate")),
    *((RobotConfig, name) for name in ("connect_timeout", "feedback_timeout")),
    *((RobotConfig, name) for name in ("max_linear", "max_angular", "max_wheel_speed")),
    *((RobotConfig, f"{side}_wheel_radius_multiplier") for side in ("left", "right")),
    *((MotorConfig, name) for name in ("max_speed", "acceleration", "gain")),
    *((EncoderConfig, name) for name in ("counts_per_revolution", "window", "quantum")),
    *((FirmwareConfig, name) for name in ("loop_rate", "feedback_rate", "command_timeout")),
    *((BodyConfig, name) for name in ("mass", "length", "width", "height")),
    *((BodyConfig, name) for name in ("friction", "slip_speed")),
]


def name_of(model: type[Any], field: str) -> str:
    """The field as users write it in a YAML file."""
    return f"{model.section}.{field}" if model.section else field


def test_defaults_are_those_of_the_robots_driver() -> None:
    config = RobotConfig()
    assert (config.wheel_radius, config.wheel_separation) == (0.05, 0.3)
    assert (config.odom_frame, config.base_frame, config.lidar_frame) == (
        "odom",
        "base_link",
        "lidar_link",
    )
    assert (config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset) == (-0.15, 0, 0.37)
    assert config.serial_port is None
    assert config.baud_rate == 115200
    assert config.control_rate == 100.0
    assert config.trailing_comma is True
    assert config.wheel_separation_multiplier == 1.0


def test_derived_values() -> None:
    config = config_of(wheel_separation=0.4, wheel_separation_multiplier=1.5, control_rate=50)
    assert config.effective_separation == pytest.approx(0.6)
    assert config.period == pytest.approx(0.02)
    assert config.feedback_rate == 50
    assert config.with_(firmware={"feedback_rate": 20}).feedback_rate == 20


@pytest.mark.parametrize("name", ["wheel_radius", "baud_rate", "motor", "made_up"])
def test_a_config_is_frozen(name: str) -> None:
    config = RobotConfig()
    with pytest.raises(ValidationError):
        setattr(config, name, 1)
    with pytest.raises(ValidationError, match="frozen"):
        setattr(config.motor, "max_speed", 1)  # noqa: B010 - the type checker forbids it, too
    assert config == RobotConfig()


def test_equal_configs_are_one_key_and_survive_pickling() -> None:
    config = config_of(wheel_radius=0.1, motor={"max_speed": 20})
    same = config_of(wheel_radius=0.1, motor=MotorConfig(max_speed=20))
    assert {config, same} == {config}
    assert config != RobotConfig()
    assert pickle.loads(pickle.dumps(config)) == config  # noqa: S301 - our own bytes


@pytest.mark.parametrize(
    ("bad", "allowed"),
    [
        (0, "must be greater than 0"),
        (-1, "must be greater than 0"),
        (math.nan, "must be a finite number"),
        (math.inf, "must be a finite number"),
        ("fast", "must be a valid (number|integer)"),
        ([1], "must be a valid (number|integer)"),
    ],
    ids=str,
)
@pytest.mark.parametrize(("model", "field"), POSITIVE)
def test_a_bad_number_names_field_value_and_what_is_allowed(
    model: type[Any], field: str, bad: object, allowed: str
) -> None:
    message = refusal(model, {field: bad})
    assert message.startswith(f"{name_of(model, field)} = {bad!r}: ")
    assert re.search(allowed, message)


@pytest.mark.parametrize(
    ("model", "field", "bad", "allowed"),
    [
        (RobotConfig, "wheel_radius", None, "must be a valid number"),
        (RobotConfig, "serial_port", 3, "must be a valid string"),
        (RobotConfig, "odom_frame", 3, "must be a valid string"),
        (RobotConfig, "lidar_x_offset", math.inf, "must be a finite number"),
        (RobotConfig, "trailing_comma", "maybe", "must be a valid boolean"),
        (RobotConfig, "baud_rate", 4800, "must be one of 9600, 19200, 38400, 57600, 115200"),
        (RobotConfig, "baud_rate", 230400, "must be one of 9600, 19200, 38400, 57600, 115200"),
        (RobotConfig, "baud_rate", "quick", "must be a valid integer"),
        (MotorConfig, "time_constant", -0.1, "must be greater than or equal to 0"),
        (MotorConfig, "deadband", -0.1, "must be greater than or equal to 0"),
        (FirmwareConfig, "processing_time", -1, "must be greater than or equal to 0"),
        (FirmwareConfig, "command_delay", 1.5, "must be less than or equal to 1"),
        (EncoderConfig, "counts_per_revolution", 1.5, "must be a valid integer"),
        (BodyConfig, "turn_factor", 1.0, "must be greater than 1"),
        (MotorConfig, "gain", [1.0, 2.0], "must be a valid number, or four for the wheels a, b"),
        (MotorConfig, "deadband", "none", "must be a valid number"),
    ],
)
def test_other_bad_values_say_what_is_allowed(
    model: type[Any], field: str, bad: object, allowed: str
) -> None:
    message = refusal(model, {field: bad})
    assert message.startswith(f"{name_of(model, field)} = {bad!r}: {allowed}")


@pytest.mark.parametrize("bad", [None, 3, "fast"])
def test_a_section_that_is_none_is_named(bad: object) -> None:
    assert refusal(RobotConfig, {"motor": bad}).startswith(f"motor = {bad!r}: must be")


@pytest.mark.parametrize("field", ["gain", "acceleration", "time_constant", "deadband"])
def test_motor_values_are_one_number_or_four(field: str) -> None:
    one, four = config_of(motor={field: 2}), config_of(motor={field: [1, "2", 3.0, 4]})
    assert [getattr(one.motor.of_wheel(wheel), field) for wheel in range(4)] == [2.0] * 4
    assert [getattr(four.motor.of_wheel(wheel), field) for wheel in range(4)] == [1, 2, 3, 4]
    assert getattr(four.motor, field) == (1.0, 2.0, 3.0, 4.0)
    assert RobotConfig(**four.model_dump(mode="json")) == four
    message = refusal(RobotConfig, {"motor": {field: [1.0, 2.0, -3.0, 4.0]}})
    assert message.startswith(f"motor.{field} = -3.0: must be greater than")


def test_a_bad_delay_sample_is_one_error() -> None:
    message = refusal(FirmwareConfig, {"delay_samples": [0.0, -0.1]})
    assert message == "firmware.delay_samples.1 = -0.1: must be greater than or equal to 0"


def test_the_left_and_right_radii() -> None:
    config = config_of(left_wheel_radius_multiplier=0.98, right_wheel_radius_multiplier=1.02)
    assert config.wheel_radii == pytest.approx((0.049, 0.051))


def test_long_values_are_shortened() -> None:
    assert len(refusal(RobotConfig, {"wheel_radius": ["x" * 1000] * 1000})) < 300
    assert "a very long number" in refusal(RobotConfig, {"wheel_radius": 16**5000})


def test_all_bad_fields_are_in_one_message() -> None:
    message = refusal(RobotConfig, {"wheel_radius": -1, "wheelbase": "x", "max_lin": 1})
    assert "wheel_radius = -1" in message
    assert "wheelbase = 'x'" in message
    assert "did you mean 'max_linear'?" in message


@pytest.mark.parametrize(
    ("values", "typo", "meant"),
    [
        ({"wheel_radus": 0.1}, "wheel_radus", "wheel_radius"),
        ({"baudrate": 9600}, "baudrate", "baud_rate"),
        ({"port": "COM3"}, "port", "serial_port"),
        ({"motr": {}}, "motr", "motor"),
        ({"motor": {"max_sped": 1}}, "motor.max_sped", "max_speed"),
        ({"firmware": {"feedbackrate": 1}}, "firmware.feedbackrate", "feedback_rate"),
    ],
)
def test_a_typo_gets_a_suggestion(values: dict[str, Any], typo: str, meant: str) -> None:
    assert f"unknown field '{typo}'; did you mean '{meant}'?" in refusal(RobotConfig, values)


def test_a_name_like_no_other_gets_the_list_of_names() -> None:
    message = refusal(MotorConfig, {"zzz": 1})
    assert "unknown field 'motor.zzz'" in message
    assert "acceleration, deadband, gain, max_speed, time_constant" in message


def test_sections_come_as_mappings_or_as_objects() -> None:
    config = config_of(motor={"max_speed": 20}, body=BodyConfig(mass=7))
    assert (config.motor.max_speed, config.body.mass) == (20, 7)
    assert config.motor.time_constant == MotorConfig().time_constant
    assert config.firmware == FirmwareConfig()
    assert config_of(firmware={"command_timeout": None}).firmware.command_timeout is None


def test_with_changes_a_validated_copy_and_keeps_the_rest() -> None:
    config = config_of(wheelbase=0.25, motor={"max_speed": 20})
    changed = config.with_(wheel_radius=0.1, encoder={"window": 0.1})
    assert (changed.wheel_radius, changed.encoder.window) == (0.1, 0.1)
    assert (changed.wheelbase, changed.motor) == (0.25, config.motor)
    assert (config.wheel_radius, config.encoder) == (0.05, EncoderConfig())
    assert config.with_() == config


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"wheel_radius": -1}, "wheel_radius = -1: must be greater than 0"),
        ({"wheel_radus": 1}, "did you mean 'wheel_radius'?"),
        ({"baud_rate": 9600}, "control_rate needs 100"),
        ({"control_rate": 30}, "whole multiple of control_rate = 30 Hz"),
        ({"motor": {"max_speed": 0}}, "max_speed = 0: must be greater than 0"),
    ],
)
def test_with_refuses_what_the_constructor_refuses(changes: dict[str, Any], found: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RobotConfig().with_(**changes)
    assert found in str(caught.value)


def test_of_takes_a_config_a_file_a_preset_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("wheel_radius: 0.07\n")
    config = config_of(wheel_radius=0.07)
    assert RobotConfig.of(config) is config
    assert RobotConfig.of(path) == RobotConfig.of(str(path)) == config
    assert RobotConfig.of(None) == RobotConfig.of("acsar") == RobotConfig.preset("acsar")
    with pytest.raises(ConfigError, match="did you mean 'acsar'"):
        RobotConfig.of("acsr")
