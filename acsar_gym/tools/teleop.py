"""Driving by keyboard, by gamepad or with a fixed twist, on any link."""

from __future__ import annotations

import contextlib
import itertools
import math
import sys
from collections.abc import Callable

from blessed import Terminal

from acsar_gym.errors import CommandError, escape_unprintable, require_extra
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.streams import print_error
from acsar_gym.worlds import Scene

KEY_TIMEOUT = 0.5
"""How long a key drives. A key that is held comes again, by the terminal's repetition [s]."""
SPEED_SHARE = 0.2
"""Speed at the start, as a share of the full speed."""
SHOW_EVERY = 10
"""Ticks between two updates of the status line."""
KEY_HELP = (
    "hold w/s to drive forward/back, a/d to turn left/right (arrows work too): "
    f"{KEY_TIMEOUT:g} s without them stops,\n"
    "1 to 9 and 0 set the speed, 10 % to 100 % (now "
    f"{SPEED_SHARE:.0%}), space stops, q quits,\n"
    "e or Esc emergency stop; after it, r releases it and sets the odometry to zero"
)
GAMEPAD_HELP = (
    "hold LB (L1) to drive, letting go stops: right trigger forward, left trigger back, "
    "left stick turns,\n"
    "B (circle) emergency stop; after it, Start releases it and sets the odometry to zero;\n"
    "Back (Select) quits"
)
AHEAD_KEYS = {"w": 1.0, "KEY_UP": 1.0, "s": -1.0, "KEY_DOWN": -1.0}
"""Keys that drive, and the direction."""
TURN_KEYS = {"a": 1.0, "KEY_LEFT": 1.0, "d": -1.0, "KEY_RIGHT": -1.0}
"""Keys that turn, and the direction."""
SPEED_KEYS = {str(tenth % 10): tenth / 10.0 for tenth in range(1, 11)}
"""Keys that set the speed."""


def drive_twist(robot: Robot, linear: float, angular: float, duration: float | None) -> None:
    """Drive with a constant twist."""
    seconds = duration or 0.0
    if not (math.isfinite(linear + angular) and 0.0 <= seconds < math.inf):
        raise CommandError(
            "--linear and --angular must be finite numbers, --duration finite and not negative"
        )

    # Ticks are counted, as they are exact in simulation.
    ticks = None if duration is None else round(duration * robot.config.control_rate)
    with robot:
        start = robot.link.now()
        for tick in itertools.count(1) if ticks is None else range(1, ticks + 1):
            robot.drive(linear, angular)
            robot.safety.check(robot.link.now() - start)
            if tick % SHOW_EVERY == 0 and sys.stdout.isatty():
                _print_status(robot)
        _print_status(robot)
    sys.stdout.write("\n")


def drive_keyboard(robot: Robot) -> None:
    """Drive from the keyboard, until q or Ctrl-C."""
    # Keys are read if the output, or at least the errors, go to a terminal.
    screens = [stream for stream in (sys.__stdout__, sys.__stderr__) if stream and stream.isatty()]
    if not (screens and sys.stdin.isatty()):
        raise CommandError(
            "no keyboard here: give a fixed twist with --linear and --angular, or --gamepad"
        )
    # Only read keys, without queries to the terminal.
    terminal = Terminal(stream=screens[0], force_styling=None)
    keys = DriveKeys()

    def read_keys() -> tuple[float, float] | None:
        while key := terminal.inkey(timeout=0, esc_delay=0):  # no waiting in the control loop
            if key == "q":
                return None
            if key == "e" or key.name == "KEY_ESCAPE":
                robot.estop()
            elif key == "r" and robot.safety.stopped:
                _release_estop(robot)
                keys.press(" ", robot.link.now())
            keys.press(str(key.name or key), robot.link.now())
        return keys.twist(robot.link.now())

    print(KEY_HELP)
    with robot, terminal.cbreak():
        _follow(robot, read_keys, release="r")


def drive_gamepad(robot: Robot, device: str = "") -> None:
    """Drive with a gamepad, until its Back button or Ctrl-C.

    If the pad is lost, the robot is held at zero until it is back and LB is pressed again.
    """
    if sys.platform != "linux":
        raise CommandError("--gamepad reads Linux's input events: drive with the keyboard here")
    with require_extra("--gamepad", "gamepad"):
        from acsar_gym.tools.gamepad import Gamepad, PadEvent  # noqa: PLC0415

    with contextlib.closing(Gamepad(device)) as pad, robot:

        def read_pad() -> tuple[float, float] | None:
            for event in pad.poll():
                if event is PadEvent.QUIT:
                    return None
                if event is PadEvent.STOP:
                    robot.estop()
                elif event is PadEvent.RELEASE and robot.safety.stopped:
                    pad.controls.disarm()
                    _release_estop(robot)
                elif event in (PadEvent.LOST, PadEvent.BACK):
                    below = "\n" if sys.stdout.isatty() else ""  # the status line
                    text = escape_unprintable(f"{pad.name}: {event.value}")
                    print_error(f"{below}acsar-gym: {text}")
            return pad.controls.twist()

        print(f"{escape_unprintable(pad.name)}: {GAMEPAD_HELP}")
        _follow(robot, read_pad, release="Start")


def _follow(robot: Robot, read: Callable[[], tuple[float, float] | None], release: str) -> None:
    """Drive with shares of the full speeds as long as there are any."""
    config = robot.config
    for tick in itertools.count():
        command = read()
        if command is None:
            sys.stdout.write("\n")
            return
        # Shares of the full speeds, within the limits of the safety layer.
        linear, angular = command
        robot.drive(linear * config.max_linear, angular * config.max_angular)
        if tick % SHOW_EVERY == 0 and sys.stdout.isatty():
            _print_status(robot, release)


def _release_estop(robot: Robot) -> None:
    robot.release_estop()
    robot.reset(Scene())


class DriveKeys:
    """The twist that keys request. Each drives or turns until `KEY_TIMEOUT` after it came last."""

    def __init__(self) -> None:
        self._share = SPEED_SHARE
        self._ahead = (0.0, -math.inf)
        self._around = (0.0, -math.inf)

    def press(self, key: str, now: float) -> None:
        """Take a key."""
        self._share = SPEED_KEYS.get(key, self._share)
        if key in AHEAD_KEYS:
            self._ahead = (AHEAD_KEYS[key], now)
        elif key in TURN_KEYS:
            self._around = (TURN_KEYS[key], now)
        elif key == " ":
            self._ahead = self._around = (0.0, now)

    def twist(self, now: float) -> tuple[float, float]:
        """Return shares of the full linear and angular speed, -1 to 1."""
        linear, angular = (
            direction * self._share if now - since < KEY_TIMEOUT else 0.0
            for direction, since in (self._ahead, self._around)
        )
        return linear, angular


def _print_status(robot: Robot, release: str = "") -> None:
    """Write pose, twist, age of the feedback and the safety state to stdout.

    Args:
        robot: The robot.
        release: The key that releases an emergency stop.
    """
    x, y, theta = robot.odometry.pose
    linear, angular = robot.odometry.twist
    age = robot.feedback_age * 1000.0
    reason = robot.safety.reason.name if robot.safety.reason else ""
    if release and robot.safety.reason is Reason.EMERGENCY_STOP:
        reason += f": {release} releases it"
    sys.stdout.write(
        f"\rx {x:7.3f} m  y {y:7.3f} m  theta {math.degrees(theta):7.1f} deg  "
        f"v {linear:6.3f} m/s  w {angular:6.3f} rad/s  feedback {age:4.0f} ms old  {reason:29} "
    )
    sys.stdout.flush()
