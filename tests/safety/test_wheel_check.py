"""Wheels whose speeds contradict their commands are found and named, and sound ones never are.

In simulated time, through the driver, on a link that looks like a board.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import board_tools
import gymnasium
import numpy as np
import pytest
from board_like import LikeABoard, Overshooting
from serial_tools import StartEmulator, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import WheelError
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.protocol import MOTORS, WHEELS, ZERO
from acsar_gym.safety.wheel_check import WheelCheck

ACSAR = RobotConfig.preset("acsar")
AHEAD, LEFT, ARC = (0.3, 0.0), (0.0, 1.0), (0.3, 0.6)
SOON = 0.5
"""Time within which a wheel must be found [s]."""


def board(*quirks: str, config: RobotConfig = ACSAR, crossed: str = "") -> Any:
    return LikeABoard(board_tools.board(*quirks, robot=config), crossed)


def stopped(
    link: Any, twist: tuple[float, float], seconds: float = 2.0, config: RobotConfig = ACSAR
) -> tuple[float, WheelError]:
    """Time of the error since the first command [s], and the error."""
    with Robot(link, config) as robot:
        start = link.now()
        with pytest.raises(WheelError) as caught:
            for _ in range(round(seconds / config.period)):
                robot.drive(*twist)
        assert not robot.active
        return link.now() - start, caught.value


Twist = tuple[float, float]
FOUND: list[tuple[str, Twist, str]] = [
    *(
        (f"dead-wheel={MOTORS[n]}", twist, f"{WHEELS[n]} stands still")
        for n in range(4)
        for twist in (AHEAD, LEFT, (-0.2, 0.0))
    ),
    ("reversed-encoder=b", AHEAD, "front_left turns backward"),
    ("dead-encoder=d", AHEAD, "rear_right stands still"),
    ("crossed=ab", LEFT, "front_right answers front_left's"),
    ("crossed=cd", LEFT, "rear_left answers"),
    ("crossed=ab", (0.25, 1.0), "front_"),  # in an arc
]


@pytest.mark.parametrize(("fault", "twist", "said"), FOUND, ids=str)
def test_a_faulty_wheel_is_named(fault: str, twist: Twist, said: str) -> None:
    name, _, letters = fault.partition("=")
    link = board(crossed=letters) if name == "crossed" else board(fault)
    took, error = stopped(link, twist)
    assert took < SOON
    assert str(error).startswith(said)
    assert error.wheel in WHEELS
    assert "'acsar-gym doctor " in str(error)
    assert "or identify this robot" in str(error)


def test_joints_in_ros_are_to_be_checked() -> None:
    watch = WheelCheck(ACSAR, "ros2:/fox")
    with pytest.raises(WheelError, match=r"check ros2\.joints in the robot's file"):
        for _ in range(1000):
            watch.tick((5.0, 5.0, 5.0, 5.0), ZERO, 0.01, fresh=True)


UNKNOWN: list[tuple[float, dict[str, Any]]] = [
    (1.0, {"motor": {"time_constant": 0.3, "acceleration": 10.0}}),
    (1.0, {"motor": {"deadband": 1.5}}),
    (1.0, {"motor": {"time_constant": 0.3}, "firmware": {"command_delay": 0.2}}),
]


@pytest.mark.parametrize(("scale", "change"), UNKNOWN, ids=str)
def test_a_slower_board_than_configured_is_no_fault(scale: float, change: dict[str, Any]) -> None:
    """A board that nobody has identified may be slower than the usual one."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        with contextlib.closing(Robot(board(config=ACSAR.with_(**change)), ACSAR)) as robot:
            robot.activate()
            for _ in range(8):
                twist = rng.uniform(-scale, scale, 2)
                for _ in range(rng.integers(5, 100)):
                    robot.drive(twist[0] * ACSAR.max_linear, twist[1] * ACSAR.max_angular)


def identified(config: RobotConfig = ACSAR) -> RobotConfig:
    """The robot, as if its motors and its delay had been measured."""
    motor = ("gain", "deadband", "time_constant", "acceleration")
    names = (*(f"motor.{name}" for name in motor), "firmware.command_delay")
    interval = {"low": 0.05, "high": 0.1, "method": "identify"}
    return config.with_(measured=dict.fromkeys(names, interval))


@pytest.mark.parametrize("twist", [(0.05, 0.0), (0.5, 0.0), (0.0, 0.3), (0.3, -0.6)], ids=str)
@pytest.mark.parametrize("sign", [1, -1], ids=["as-wired", "as-mended"])
def test_a_wheel_that_runs_away_on_the_board_is_stopped(
    sign: int, twist: tuple[float, float]
) -> None:
    """Whatever the robot's file says of its sign, and however slow the command is."""
    link = LikeABoard(board_tools.board("runaway=a", robot=ACSAR))
    took, error = stopped(link, twist, config=ACSAR.with_(wheels={"a": {"sign": sign}}))
    assert took < SOON
    assert error.wheel == "front_right"


@pytest.mark.parametrize("turn", [1.5, 0.75, -0.75])
@pytest.mark.parametrize("config", [ACSAR, identified()], ids=["new", "identified"])
def test_swapped_sides_are_found_in_an_arc(config: RobotConfig, turn: float) -> None:
    link = LikeABoard(board_tools.board("swapped-encoders", robot=ACSAR))
    took, error = stopped(link, (0.5, turn), config=config)
    assert took < SOON
    assert "answers" in str(error)


@pytest.mark.parametrize(
    ("config", "linear", "soon"),
    [(ACSAR, 0.25, 0.75), (ACSAR, 0.5, 0.75), (identified(), 0.5, 0.75)],
)
def test_feedback_that_is_half_too_high_is_stopped(
    config: RobotConfig, linear: float, soon: float
) -> None:
    """Later than anything else: until it is steady it looks like a board that overshoots."""
    link = LikeABoard(board_tools.board("feedback-factor=1.5", robot=ACSAR))
    took, error = stopped(link, (linear, 0.0), config=config)
    assert took < soon
    assert "turns too fast" in str(error)


ROBOTS: dict[str, tuple[RobotConfig, dict[str, Any], type[LikeABoard]]] = {
    "acsar": (ACSAR, {}, LikeABoard),
    "jackal": (RobotConfig.preset("jackal"), {}, LikeABoard),
    "husky": (RobotConfig.preset("husky"), {}, LikeABoard),
    "slow": (
        ACSAR.with_(firmware={"feedback_rate": 20.0}),
        {
            "motor": {"time_constant": [0.3, 0.2, 0.3, 0.25], "acceleration": 10, "deadband": 1.2},
            "firmware": {"command_delay": 0.2},
            "encoder": {"quantum": 0.35, "window": 0.1},
        },
        LikeABoard,
    ),
    "uneven": (
        RobotConfig.preset("jackal"),
        {"motor": {"time_constant": [0.08, 0.2, 0.2, 0.08], "gain": [1.1, 0.9, 0.9, 1.1]}},
        LikeABoard,
    ),
    "overshooting": (ACSAR, {}, Overshooting),
}
"""Robots as they are configured, how they differ, and the link."""
LOST = Faults(dropped_lines=0.07, late_lines=0.02)


def random_commands(rng: np.random.Generator, ticks: int) -> Iterator[np.ndarray]:
    """Twists as shares of the full ones: steady, ramps, reversals, slaloms, stops."""
    for _ in range(ticks):
        length, kind = int(rng.integers(5, 300)), rng.integers(6)
        first, last = rng.uniform(-1.0, 1.0, (2, 2)) * rng.choice([0.25, 1.0])
        pace = rng.uniform(0.001, 0.03)
        for tick in range(length):
            wave = np.sin(2.0 * np.pi * pace * tick)
            yield (
                first,
                first + (last - first) * tick / length,
                first * (-1) ** (4 * tick // length),
                first * (1.0, wave),
                first * (wave, 1.0),
                np.zeros(2),
            )[kind]


@pytest.mark.parametrize("minutes", [0.5, pytest.param(30.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ROBOTS)
def test_sound_robots_are_never_stopped(name: str, minutes: float) -> None:
    config, changes, kind = ROBOTS[name]
    own = kind(open_link("planar", config.with_(**changes)))
    link: Any = LikeABoard(FaultyLink(own, LOST))
    ticks = round(60.0 * minutes / config.period)
    with contextlib.closing(Robot(link, config)) as robot:
        robot.activate()
        for twist in itertools.islice(random_commands(np.random.default_rng(7), ticks), ticks):
            robot.drive(twist[0] * config.max_linear, twist[1] * config.max_angular)


def found_after(config: RobotConfig, seconds: float, commands: Any, *wheels: float) -> float:
    """Time until wheels that turn at these shares of their commands are stopped [s]."""
    watch = WheelCheck(config)
    for tick in range(round(seconds / 0.01)):
        asked = commands(tick)
        a, b, c, d = (share * asked for share in wheels)
        try:
            watch.tick((asked,) * 4, (a, b, c, d), 0.01, fresh=True)
        except WheelError:
            return tick * 0.01
    return seconds


@pytest.mark.parametrize("speed", [0.2, 1.0, 6.0, 20.0])
def test_how_fast_a_wheel_may_be(speed: float) -> None:
    """At most 40 % and a little too fast."""
    assert found_after(ACSAR, 5.0, lambda _: speed, 1.4, 1.0, 1.0, 1.0) == 5.0
    over = 1.4 + 0.6 / speed
    assert found_after(ACSAR, 5.0, lambda _: speed, over, 1.0, 1.0, 1.0) < SOON
    assert found_after(ACSAR, 5.0, lambda _: speed, -over, 1.0, 1.0, 1.0) < SOON


def test_stops_and_pauses_are_no_fault() -> None:
    """An emergency stop, stale feedback, and a program that pauses until the board stops."""
    config = ACSAR.with_(firmware={"command_timeout": 0.1})
    link = board(config=config)
    with Robot(link, config) as robot:
        for pause in (0.0, 0.08, 0.3, 1.0):
            for _ in range(100):
                robot.drive(*AHEAD)
            if pause:
                link.advance(pause)
        robot.estop()
        for _ in range(100):
            robot.drive(*AHEAD)


def test_a_robot_that_stands_may_be_pushed() -> None:
    watch = WheelCheck(ACSAR)
    for _ in range(500):
        watch.tick((0.0, 0.0, 0.0, 0.0), (4.0, 4.0, 4.0, 4.0), 0.01, fresh=True)


def test_the_check_can_be_switched_off() -> None:
    config = ACSAR.with_(wheel_check=False)
    with Robot(board("dead-wheel=a", config=config), config) as robot:
        for _ in range(100):
            robot.drive(*AHEAD)


def test_simulated_robots_are_not_judged() -> None:
    """A batch has no such check, and both must do the same."""
    with Robot(board_tools.board("dead-wheel=a", robot=ACSAR), ACSAR) as robot:
        for _ in range(100):
            robot.drive(*AHEAD)


def test_an_environment_truncates_the_episode() -> None:
    link: Any = board("reversed-encoder=b")
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link)
    env.reset(seed=0)
    for _ in range(10):
        *_, truncated, info = env.step(np.array([0.6, 0.0], np.float32))
        if truncated:
            break
    assert info["fault"] == 6.0
    assert "front_left turns backward" in info["fault_reason"]
    env.close()


@pytest.mark.usefixtures("deadline")
def test_slow_feedback_of_zeros_ends_a_drive(start_emulator: StartEmulator) -> None:
    """Over a pseudo-terminal, at a rate that the robot's file doesn't name."""
    board = start_emulator("--quirk", "feedback-rate=10", "feedback-factor=0")
    with (
        Robot(open_link(board.device, ACSAR), ACSAR) as robot,
        pytest.raises(WheelError, match="all wheels stand still"),
    ):
        for _ in range(500):
            robot.drive(*AHEAD)
    wait_until(board.is_stopped, "zero as the newest command")
