"""A Gymnasium environment for the ACSAR skid-steer robot, simulated or real behind one wire.

The import registers the environments' ids with Gymnasium. The names below are imported when they
are used first, as some bring numba and pydantic, for which `acsar-gym estop` must not wait.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from acsar_gym import registration

if TYPE_CHECKING:
    from acsar_gym import envs, errors, kinematics, odometry, protocol, worlds
    from acsar_gym.config import RobotConfig
    from acsar_gym.envs.robot_env import RobotEnv
    from acsar_gym.links import Link, open_link
    from acsar_gym.registration import register
    from acsar_gym.robot import Robot
    from acsar_gym.sensors import Sensor
    from acsar_gym.tasks import Outcome, State, Task
    from acsar_gym.worlds import World

__version__ = "0.2.0"
__all__ = [
    "Link",
    "Outcome",
    "Robot",
    "RobotConfig",
    "RobotEnv",
    "Sensor",
    "State",
    "Task",
    "World",
    "envs",
    "errors",
    "kinematics",
    "odometry",
    "open_link",
    "protocol",
    "register",
    "worlds",
]
_HOMES = {
    "Link": "links",
    "Outcome": "tasks",
    "Robot": "robot",
    "RobotConfig": "config",
    "RobotEnv": "envs.robot_env",
    "Sensor": "sensors",
    "State": "tasks",
    "Task": "tasks",
    "World": "worlds",
    "open_link": "links",
    "register": "registration",
}
"""The modules in which names are defined. Every other name is a module's."""


def __getattr__(name: str) -> Any:
    """A name of `__all__` or a module of this package, imported now."""
    if name.startswith("_"):
        raise AttributeError(f"module 'acsar_gym' has no attribute {name!r}")
    home = f"acsar_gym.{_HOMES.get(name, name)}"
    try:
        module = importlib.import_module(home)
    except ModuleNotFoundError as error:
        # A module that is there, but imports a module that is missing, is another error.
        if error.name != home:
            raise
        raise AttributeError(f"module 'acsar_gym' has no attribute {name!r}") from error
    # Kept, so that this function runs once for each name.
    value = getattr(module, name) if name in _HOMES else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


registration.register_all()
