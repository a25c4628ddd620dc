"""The table of simulated bodies: what simulates a robot behind its wire, by name.

A simulator is imported when its body is made: a robot's onboard computer needs none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, check_extra, suggest_name
from acsar_gym.physics.body import Body


class BodyBackend(NamedTuple):
    """How a kind of body is made.

    Attributes: `title`, its name in tables; `make`, makes one for a robot, with the simulator's own
    window or without; `has_window`, whether the simulator has one; `has_camera`, whether it takes
    pictures; `unused`, parameters of `Randomization` that have no effect; `module`, the
    simulator's, and `extra`, which installs it, both empty for our own.
    """

    title: str
    make: Callable[[RobotConfig, bool], Body]
    has_window: bool = False
    has_camera: bool = False
    unused: tuple[str, ...] = ()
    module: str = ""
    extra: str = ""


def _make_planar(config: RobotConfig, window: bool) -> Body:
    from acsar_gym.physics.planar import PlanarBody  # noqa: PLC0415

    return PlanarBody(config)


def _make_bullet(config: RobotConfig, window: bool) -> Body:
    from acsar_gym.physics.bullet import BulletBody  # noqa: PLC0415

    return BulletBody(config, window=window)


def _make_mujoco(config: RobotConfig, window: bool) -> Body:
    from acsar_gym.physics.mujoco import MujocoBody  # noqa: PLC0415

    return MujocoBody(config)


BODIES = {
    "planar": BodyBackend("planar", _make_planar),
    "bullet": BodyBackend(
        "PyBullet",
        _make_bullet,
        has_window=True,
        has_camera=True,
        module="pybullet",
        extra="bullet",
    ),
    "mujoco": BodyBackend(
        "MuJoCo",
        _make_mujoco,
        has_camera=True,
        unused=("turn_factor",),
        module="mujoco",
        extra="mujoco",
    ),
}
"""Bodies by name; the links that simulate them have the same names."""
LINKS_WITH_CAMERA = " or ".join(repr(name) for name, body in BODIES.items() if body.has_camera)
"""For messages."""


def check_installed(name: str) -> None:
    """Raise MissingExtraError where the simulator of a body of the table isn't installed.

    Args:
        name: such as "bullet".
    """
    body = BODIES[name]
    if body.module:
        check_extra(f"the {body.title} robot", body.extra, body.module)


def make_body(name: str, config: RobotConfig, *, window: bool = False) -> Body:
    """Make a body of the table.

    Args:
        name: such as "planar".
        config: of the robot.
        window: open the simulator's window.

    Raises:
        ConfigError: for any other name.
        MissingExtraError: the simulator isn't installed.
    """
    if name not in BODIES:
        raise ConfigError(f"unknown body {name!r}{suggest_name(name[:40], BODIES)}")
    return BODIES[name].make(config, window)
