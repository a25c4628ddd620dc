"""The table of simulated bodies: what simulates a robot behind its wire, by name.

A simulator is imported when its body is made: a robot's onboard computer needs none.
"""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, check_extra, suggest_name
from acsar_gym.physics.body import Body


class BodyBackend(NamedTuple):
    """How a kind of body is made."""

    title: str
    """Its name in tables."""
    kind: str
    """Its class in this package, "module:Class"."""
    has_window: bool = False
    """Whether the simulator has a window."""
    has_camera: bool = False
    """Whether the simulator takes pictures."""
    unused: tuple[str, ...] = ()
    """Parameters of `Randomization` that have no effect."""
    module: str = ""
    """Module of the simulator, or empty for our own."""
    extra: str = ""
    """Extra that installs the simulator."""


BODIES = {
    "planar": BodyBackend("planar", "planar:PlanarBody"),
    "bullet": BodyBackend(
        "PyBullet",
        "bullet:BulletBody",
        has_window=True,
        has_camera=True,
        module="pybullet",
        extra="bullet",
    ),
    "mujoco": BodyBackend(
        "MuJoCo",
        "mujoco:MujocoBody",
        has_camera=True,
        unused=("turn_factor",),
        module="mujoco",
        extra="mujoco",
    ),
}
"""Bodies by name. The links that simulate them have the same names."""
LINKS_WITH_CAMERA = " or ".join(repr(name) for name, body in BODIES.items() if body.has_camera)
"""For messages."""


def check_installed(name: str) -> None:
    """Raise MissingExtraError if the simulator of a body of the table isn't installed."""
    body = BODIES[name]
    if body.module:
        check_extra(f"the {body.title} robot", body.extra, body.module)


def make_body(name: str, config: RobotConfig, *, window: bool = False) -> Body:
    """Make a body of the table.

    Args:
        name: Name of the body.
        config: Robot configuration.
        window: Whether to open the simulator's window, if it has a window.

    Raises:
        ConfigError: There is no such body, or the robot can't be simulated.
        MissingExtraError: The simulator isn't installed.
    """
    config.check_simulated()
    if name not in BODIES:
        raise ConfigError(f"unknown body {name!r}{suggest_name(name[:40], BODIES)}")
    backend = BODIES[name]
    module, _, kind = backend.kind.partition(":")
    make: Any = getattr(importlib.import_module(f"acsar_gym.physics.{module}"), kind)
    body: Body = make(config, window=window) if backend.has_window else make(config)
    return body
