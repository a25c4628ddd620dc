"""Driving by keyboard or with a fixed twist, on any link."""

from __future__ import annotations

import itertools
import math
import sys

from blessed import Terminal

from acsar_gym.errors import CommandError
from acsar_gym.robot import Robot
from acsar_gym.worlds import Scene

STEP = 0.1
"""Change of the speed by one key press, as a share of the full speed."""
SHOW_EVERY = 10
"""Ticks between two updates of the status line."""
HELP = (
    "w/s faster/slower, a/d turn left/right, space stops, q quits (arrows work too),\n"
    "e or Esc emergency stop, r re-arms after it and sets the odometry to zero"
)
KEYS = {
    "w": (1, 0),
    "KEY_UP": (1, 0),
    "s": (-1, 0),
    "KEY_DOWN": (-1, 0),
    "a": (0, 1),
    "KEY_LEFT": (0, 1),
    "d": (0, -1),
    "KEY_RIGHT": (0, -1),
}


def fixed(robot: Robot, linear: float, angular: float, duration: float | None) -> None:
    """Drive with a constant twist.

    Args:
        robot: an open robot.
        linear: linear velocity [m/s].
        angular: angular velocity [rad/s].
        duration: time [s]; None until interrupted.

    Raises:
        CommandError: a velocity isn't finite.
        LinkError: the robot was stopped, or its link failed.
    """
    if not (math.isfinite(linear + angular) and 0.0 <= (duration or 0.0) < math.inf):
        raise CommandError(
            "--linear and --angular must be finite numbers, --duration finite and not negative"
        )
    ticks = math.inf if duration is None else round(duration * robot.config.control_rate)
    done = 0
    with robot:
        begin = robot.link.now()
        while done < ticks:
            robot.drive(linear, angular)
            robot.safety.check(robot.link.now() - begin)
            done += 1
            if done % SHOW_EVERY == 0:
                _show(robot)
        _print_status(robot)
    sys.stdout.write("\n")


def keyboard(robot: Robot) -> None:
    """Drive from the keyboard, until q or Ctrl-C.

    Args:
        robot: an open robot.
    """
    if not sys.stdin.isatty():
        raise CommandError("no keyboard here: give a fixed twist with --linear and --angular")
    terminal = Terminal(force_styling=None)  # only read keys; don't query the terminal
    linear = angular = 0.0
    print(HELP)
    with robot, terminal.cbreak():
        for tick in itertools.count():
            key = terminal.inkey(timeout=0, esc_delay=0)  # no waiting in the control loop
            if key == "q":
                break
            if key == "e" or key.name == "KEY_ESCAPE":
                robot.estop()
            elif key == "r" and robot.safety.stopped:
                robot.reset(Scene())
                linear = angular = 0.0
            linear, angular = pressed(str(key.name or key), linear, angular)
            config = robot.config
            robot.drive(linear * config.max_linear, angular * config.max_angular)
            if tick % SHOW_EVERY == 0:
                _show(robot)
    sys.stdout.write("\n")


def pressed(key: str, linear: float, angular: float) -> tuple[float, float]:
    """Compute the twist after a key press.

    Args:
        key: name of the key; unknown keys change nothing.
        linear: share of the full linear speed, -1 to 1.
        angular: share of the full angular speed, -1 to 1.

    Returns:
        The new shares (linear, angular).
    """
    if key == " ":
        return 0.0, 0.0
    more, turn = KEYS.get(key, (0, 0))
    return _share(linear + more * STEP), _share(angular + turn * STEP)


def _share(value: float) -> float:
    """Clip to [-1, 1], without rounding noise near zero."""
    return round(min(max(value, -1.0), 1.0), 3)


def _show(robot: Robot) -> None:
    """Print the status line if stdout is a terminal."""
    if not sys.stdout.isatty():
        return
    _print_status(robot)


def _print_status(robot: Robot) -> None:
    """Write pose, twist, age of the feedback and the safety state to stdout."""
    x, y, theta = robot.odometry.pose
    linear, angular = robot.odometry.twist
    age = robot.feedback_age * 1000.0
    reason = robot.safety.reason.name if robot.safety.reason else ""
    sys.stdout.write(
        f"\rx {x:7.3f} m  y {y:7.3f} m  theta {math.degrees(theta):7.1f} deg  "
        f"v {linear:6.3f} m/s  w {angular:6.3f} rad/s  feedback {age:4.0f} ms old  {reason:14} "
    )
    sys.stdout.flush()
