"""What episodes draw, and what it does to a robot's physics."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from varied import RANGES

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.jit import record_of
from acsar_gym.physics import Physics, Randomization, compute_physics
from acsar_gym.physics.model import loop_period
from acsar_gym.physics.randomization import Drawn, Randomizer, drawn_places, vary_physics

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
    names = [field.name for field in fields(Randomization)]
    assert sorted(place for name in names for place in drawn_places(name)) == list(
        range(len(Drawn()))
    )
    assert set(RANGES) == set(CHANGES) == set(names)


def test_numbers_keep_their_names_on_the_way_into_compiled_code() -> None:
    own = Physics(*map(float, range(len(Physics._fields))))
    assert tuple(record_of(own)[0]) == own


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


def test_times_are_whole_loops_of_the_firmware_and_told_as_such() -> None:
    own, info = drawn(RANGES)
    assert own.latency_loops == round(own.latency_loops) > 0
    assert own.feedback_loops == round(own.feedback_loops) > 0
    assert info["drawn_latency"] == pytest.approx(own.latency_loops * DT)
    assert info["drawn_feedback_rate"] == pytest.approx(1.0 / (own.feedback_loops * DT))


def test_a_seed_gives_one_robot_and_takes_one_sample_for_each_number() -> None:
    randomizer = Randomizer(RANGES, CONFIG, STEP, simulated=True)
    rng, other = np.random.default_rng(5), np.random.default_rng(5)
    first, second = randomizer.draw(rng), randomizer.draw(rng)
    assert first == drawn(RANGES, 5)[0] != second
    other.random(2 * len(Drawn()))
    assert rng.random() == other.random()


def test_a_range_of_one_value_takes_no_sample() -> None:
    own, info = drawn({"mass": (1.5, 1.5), "friction": (0.5, 1.0)}, 3)
    assert info["drawn_mass"] == 1.5
    assert info["drawn_friction"] == 0.5 + 0.5 * np.random.default_rng(3).random()
    assert own.mass == 1.5 * compute_physics(CONFIG).mass


def test_motors_without_lag_have_none_to_vary() -> None:
    own, info = drawn(RANGES, config=CONFIG.with_(motor={"time_constant": 0.0}))
    assert wheels(own, "blend") == [1.0] * 4
    assert (info["drawn_motor_lag"] == 1.0).all()


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"frictoin": (0.5, 1.0)}, "did you mean 'friction'"),
        ({3: (0.5, 1.0)}, "unknown randomization 3"),
        ({"mass": (2.0, 1.0)}, "low <= high"),
        ({"mass": 3}, r"must be \(low, high\)"),
        ({"latency": (-0.1, 0.1)}, "0 <= low"),
        ({"latency": (0.0, 0.099)}, r"takes up to 0.119 s; must be shorter than a step .*0.1 s"),
        ("mass", "must be a mapping"),
        ({"turn_factor": (0.6, 1.0)}, r"turn factor 0\.92.*: must stay above 1"),
        ({"command_delay": (0.0, 1.5)}, "low <= high <= 1"),
        ({"delay_samples": ()}, "delay_samples = .*: must be delays from 0 to 1 s"),
        ({"delay_samples": (0.0, -0.1)}, "must be delays from 0 to 1 s"),
        ({"delay_samples": 3}, "must be delays from 0 to 1 s"),
        ({"feedback_rate": (1.0, 20.0)}, "feedback_rate = .*feedback_timeout = 0.5 s"),
        ({"feedback_rate": (20.0, 190.0)}, "feedback_rate = .*baud_rate = 19200"),
    ],
)
def test_bad_ranges_are_one_clear_error(ranges: Any, message: str) -> None:
    config = CONFIG.with_(baud_rate=19200, control_rate=50.0)
    with pytest.raises(ConfigError, match=message) as raised:
        Randomization.of(ranges).ranges(config, STEP)
    assert "\n" not in str(raised.value)


def test_every_measured_delay_is_drawn_as_often_as_the_others() -> None:
    delays = (0.002, 0.003, 0.005, 0.009)
    config = CONFIG.with_(firmware={"command_delay": 0.004})
    randomizer = Randomizer({"delay_samples": delays}, config, STEP, simulated=True)
    rng = np.random.default_rng(0)
    drawn = [randomizer.draw(rng) for _ in range(4000)]
    told = [own.command_delay for own in drawn if own is not None]
    for delay in delays:
        assert told.count(0.004 + delay) == pytest.approx(1000, abs=120)


def test_a_deadband_is_never_negative() -> None:
    own, _ = drawn({"deadband_offset": (-0.5, -0.5)}, config=CONFIG.with_(motor={"deadband": 0.2}))
    assert wheels(own, "deadband") == [0.0] * 4


def test_single_wheels_without_lag_have_none_to_vary() -> None:
    config = CONFIG.with_(motor={"time_constant": [0.0, 0.1, 0.0, 0.1]})
    own, info = drawn({"motor_lag": (0.5, 0.9)}, config=config)
    assert (wheels(own, "blend")[0], wheels(own, "blend")[2]) == (1.0, 1.0)
    assert (info["drawn_motor_lag"] == 1.0).tolist() == [True, False, True, False]


def test_ranges_are_checked_however_they_are_given() -> None:
    with pytest.raises(ConfigError, match="low <= high"):
        Randomization(mass=(2.0, 1.0))
    assert Randomization(mass=(1, 2)) == Randomization.of({"mass": (1.0, 2.0)})
