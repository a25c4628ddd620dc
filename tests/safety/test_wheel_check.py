"""Wheels that contradict their commands are found and named, and sound wheels never are.

Most tests drive simulated robots that are real for the driver. `make wheel-check` drives more.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import boards
import gymnasium
import numpy as np
import pytest
from boards import FAULTS, FaultyBoard, LikeABoard, make_fault
from serial_tools import StartEmulator, wait_until

from acsar_gym import Link, Robot, RobotConfig, open_link
from acsar_gym.errors import WheelError
from acsar_gym.protocol import WHEELS, ZERO
from acsar_gym.safety.wheel_check import WheelCheck

ACSAR = RobotConfig.preset("acsar")
JACKAL = RobotConfig.preset("jackal")
AHEAD = (0.3, 0.0)
LEFT = (0.0, 1.0)
ARC = (0.3, 0.6)
LIMITS = {5.0: 2.5, 10.0: 1.5, 20.0: 0.5, 100.0: 0.5}
"""Time within which faults must be found, by the rate of the feedback [s]."""
ZEROS_LIMIT = 1.0  # the same at 20 Hz and more if all wheels are at rest


def board(kind: str, wheel: int = 0, rate: float = 100.0) -> FaultyBoard:
    """A board with a fault. The driver doesn't know the rate of its feedback."""
    link = open_link("planar", ACSAR.with_(firmware={"feedback_rate": rate}))
    return FaultyBoard(link, np.random.default_rng(wheel), make_fault(kind, wheel))


def find_fault(
    link: Link, twist: tuple[float, float], config: RobotConfig = ACSAR
) -> tuple[float, WheelError]:
    """Drive until the error. Returns the time since the first command [s], and the error."""
    with Robot(link, config) as robot:
        start = link.now()
        with pytest.raises(WheelError) as caught:
            for _ in range(300):
                robot.drive(*twist)
        assert not robot.active
        return link.now() - start, caught.value


@pytest.mark.parametrize("rate", LIMITS)
@pytest.mark.parametrize("kind", FAULTS)
def test_wheel_faults_are_found_in_time(kind: str, rate: float) -> None:
    limit = max(LIMITS[rate], ZEROS_LIMIT) if kind == "all zero" else LIMITS[rate]
    for wheel, twist in enumerate((LEFT, ARC)):
        duration, _ = find_fault(board(kind, wheel, rate), twist)
        assert duration <= limit


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize(
    ("kind", "twist", "message"),
    [
        ("dead", AHEAD, "{} stands still (6.00 rad/s commanded"),
        ("dead", (-0.2, 0.0), "{} stands still (-4.00 rad/s commanded"),
        ("reversed", AHEAD, "{} turns backward"),
        ("twice as fast", ARC, "{} turns too fast"),
    ],
)
def test_wheel_with_a_fault_is_named(
    kind: str, twist: tuple[float, float], message: str, wheel: int
) -> None:
    _, error = find_fault(board(kind, wheel), twist)
    assert error.wheel == WHEELS[wheel]
    assert str(error).startswith(message.format(WHEELS[wheel]))
    assert "'acsar-gym doctor DEVICE --spin'" in str(error)


def test_wheel_sides_that_are_swapped_are_named() -> None:
    for twist in (LEFT, (0.5, -0.75)):
        assert "answers front_" in str(find_fault(board("swapped sides"), twist)[1])


def test_wheel_error_in_ros_names_the_joints() -> None:
    check = WheelCheck(ACSAR, "ros2:/fox")
    with pytest.raises(WheelError, match=r"check ros2\.joints in the robot's file"):
        for _ in range(1000):
            check.tick((5.0, 5.0, 5.0, 5.0), ZERO, 0.01, fresh=True)


@pytest.mark.parametrize("sign", [1, -1], ids=["as-wired", "as-mended"])
def test_wheel_that_runs_away_on_the_board_is_stopped(sign: int) -> None:
    """At any sign in the robot's file, and at a slow command."""
    link = LikeABoard(boards.board("runaway=a", robot=ACSAR))
    config = ACSAR.with_(wheels={"a": {"sign": sign}})
    assert find_fault(link, (0.05, 0.0), config)[1].wheel == "front_right"


ROBOTS: dict[str, tuple[RobotConfig, dict[str, Any], float]] = {
    "acsar": (ACSAR, {}, 10.0),
    "jackal": (JACKAL, {}, 20.0),
    "husky": (RobotConfig.preset("husky"), {}, 5.0),
    "overshooting": (ACSAR, {"motor": {"deadband": 1.5}}, 100.0),
    "slow": (
        ACSAR,
        {
            "motor": {"time_constant": [0.3, 0.2, 0.3, 0.25], "acceleration": 10, "deadband": 1.2},
            "firmware": {"command_delay": 0.2},
            "encoder": {"quantum": 0.35, "window": 0.1},
        },
        100.0,
    ),
    "uneven": (
        JACKAL,
        {"motor": {"time_constant": [0.08, 0.2, 0.2, 0.08], "gain": [1.1, 0.9, 0.9, 1.1]}},
        100.0,
    ),
}
"""Robots as they are known, how they differ, and the rate of their feedback [Hz]."""


def random_commands(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Twists as shares of the full twist: steady, ramps, reversals, slaloms."""
    while True:
        length = int(rng.integers(5, 300))
        kind = rng.integers(4)
        first, last = rng.uniform(-1.0, 1.0, (2, 2)) * rng.choice([0.25, 1.0])
        for tick in range(length):
            share = tick / length
            yield (
                first,
                first + share * (last - first),
                first * (-1) ** int(4 * share),
                first * (1.0, np.sin(20.0 * share)),
            )[kind]


@pytest.mark.parametrize("minutes", [0.5, pytest.param(30.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ROBOTS)
def test_wheel_check_never_stops_sound_robots(name: str, minutes: float) -> None:
    config, changes, rate = ROBOTS[name]
    hidden = config.with_(firmware={"feedback_rate": rate}).with_(**changes)
    quirks = ("overshoot=0.25",) if name == "overshooting" else ()
    link = FaultyBoard(boards.board(*quirks, robot=hidden), np.random.default_rng(0), dropped=0.02)
    patient = config.with_(feedback_timeout=2.0)
    with contextlib.closing(Robot(link, patient)) as robot:
        robot.activate()
        commands = random_commands(np.random.default_rng(7))
        for twist in itertools.islice(commands, round(60.0 * minutes / config.period)):
            robot.drive(twist[0] * config.max_linear, twist[1] * config.max_angular)


def test_wheel_check_of_stops_and_pauses() -> None:
    """An emergency stop, and a program that pauses until the board stops."""
    config = ACSAR.with_(firmware={"command_timeout": 0.1})
    link = LikeABoard(open_link("planar", config))
    with Robot(link, config) as robot:
        for pause in (0.0, 0.08, 0.3, 1.0):
            for _ in range(100):
                robot.drive(*AHEAD)
            if pause:
                link.advance(pause)
        robot.estop()
        for _ in range(100):
            robot.drive(*AHEAD)


def test_wheel_check_can_be_switched_off() -> None:
    """A batch has no such check, and the single env must do the same."""
    with Robot(board("dead"), ACSAR.with_(wheel_check=False)) as robot:
        for _ in range(100):
            robot.drive(*AHEAD)


def test_wheel_fault_truncates_the_episode() -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=board("reversed", wheel=1))
    env.reset(seed=0)
    steps = (env.step(np.array([0.6, 0.0], np.float32)) for _ in range(10))
    info = next(info for *_, truncated, info in steps if truncated)
    assert info["fault"] == 6.0
    assert "front_left turns backward" in info["fault_reason"]
    env.close()


@pytest.mark.usefixtures("deadline")
def test_wheel_check_of_slow_feedback(start_emulator: StartEmulator, config: RobotConfig) -> None:
    """Over a pseudo-terminal, at a rate that the robot's file doesn't contain."""
    emulator = start_emulator("--quirk", "feedback-factor=0", "feedback-rate=10")
    error = find_fault(open_link(emulator.device, config), AHEAD, config)[1]
    assert "all wheels stand still" in str(error)
    wait_until(emulator.is_stopped, "zero as the newest command")
