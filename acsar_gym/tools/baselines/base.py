"""The base class of the baselines, and their constants in units of the robot.

Lengths are in radii of the disc around the footprint, speeds in top speeds, and costs that compare
ways are in seconds at top speed, so that a robot twice as large and four times as fast needs no
other numbers. `constants.yaml` has those that a search found for the presets.
"""

from __future__ import annotations

import functools
import typing
from abc import abstractmethod
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig, footprint
from acsar_gym.envs.ids import strip_module
from acsar_gym.resources import hash_modules
from acsar_gym.safety.rules import read_limits
from acsar_gym.tasks import Observation
from acsar_gym.tools.policies.policy import DecodedObservation, FilePolicy, PolicyContext

CONSTANTS_FILE = Path(__file__).with_name("constants.yaml")
UNLIMITED = 1e3
"""Stands for an acceleration without a limit [m/s^2, rad/s^2]."""
Radii = Annotated[float, "radius"]
Speeds = Annotated[float, "speed"]
YawRates = Annotated[float, "turning"]
Periods = Annotated[float, "period"]
"""Constants as multiples of a field of `RobotUnits`. Those of type float are in SI units."""


class RobotUnits(NamedTuple):
    """The robot's limits, of which the constants of the baselines are multiples."""

    radius: float
    """Radius of the disc around the footprint [m]."""
    speed: float
    """Top speed [m/s]."""
    turning: float
    """Greatest yaw rate [rad/s]."""
    acceleration: float
    """Greatest acceleration, by command limits and wheels [m/s^2]."""
    spin: float
    """Greatest angular acceleration, likewise [rad/s^2]."""
    braking: float
    """Deceleration of a full stop, which the command limits don't slow down [m/s^2]."""
    lag: float
    """Mean time constant of the motors [s]."""
    period: float
    """Time between two decisions [s]."""

    @classmethod
    def of(cls, config: RobotConfig, period: float) -> RobotUnits:
        """Return the units of a robot that decides every `period` [s]."""
        # The slowest motor limits all wheels.
        motors = [config.motor.of_wheel(wheel) for wheel in range(4)]
        ramp = min(motor.acceleration for motor in motors) * config.wheel_radius
        forward = read_limits(config.linear_limits, config.max_linear).max_acceleration
        turning = read_limits(config.angular_limits, config.max_angular).max_acceleration

        # A full stop isn't slowed down by the command limits, so braking is that of the motors.
        return cls(
            radius=footprint.outline_radius(config.outline),
            speed=config.max_linear,
            turning=config.max_angular,
            acceleration=min(forward, ramp, UNLIMITED),
            spin=min(turning, 2.0 * ramp / config.effective_separation, UNLIMITED),
            braking=min(ramp, UNLIMITED),
            lag=sum(motor.time_constant for motor in motors) / 4.0,
            period=period,
        )

    def scale(self, constants: Any) -> Any:
        """Return constants in SI units: each times the unit that its annotation names."""
        # Numbers of type float are in SI units already.
        hints = typing.get_type_hints(type(constants), include_extras=True)
        scaled = {
            name: getattr(constants, name) * getattr(self, hint.__metadata__[0])
            for name, hint in hints.items()
            if hint is not float
        }
        return constants._replace(**scaled)


@functools.cache
def read_constants() -> Any:
    """Read `constants.yaml`: by planner, name of the id, robot and constant."""
    return reading.parse_yaml(CONSTANTS_FILE.read_text(encoding="utf-8"))


def find_constants(planner: str, env_id: str, config: RobotConfig) -> dict[str, float]:
    """Find the constants of a planner for a preset of the same outline and top speeds.

    Returns:
        Those that aren't the defaults, by name.
    """
    # Versions of an id share constants, and so do robots that differ in mass or sensors.
    short = strip_module(env_id).rpartition("/")[2].partition("-")[0]
    shape = (config.outline, config.max_linear, config.max_angular)
    for name, constants in read_constants().get(planner, {}).get(short, {}).items():
        preset = RobotConfig.preset(name)
        if (preset.outline, preset.max_linear, preset.max_angular) == shape:
            return dict(constants)
    return {}


class BaselinePolicy(FilePolicy):
    """Base class of the baselines: they decide from the same observations as a trained policy.

    In addition they know what any deployed policy may: the robot's config and map, the layout and
    scales of the task, and its period (`setting`). A subclass of another package is named with its
    module, as in `--policy mine.module:Planner`. It has `act`, and `reset` if it remembers
    something.

    Args:
        env_id: Id of the env that it drives.
    """

    name: str = ""
    """Its name in messages, and for `--policy`. By default the name of the class."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of the task's numbers that it needs."""
    needs_in_words: ClassVar[tuple[str, str]] = ("a goal", "point_goal")
    """What these are in words, and an env that has them."""
    constants: Any = ()
    """Its constants: of the class the defaults, see `RobotUnits`, of a policy in SI units."""
    env_named = True

    def __init__(self, env_id: str) -> None:
        kind = type(self)
        self.name = vars(kind).get("name", kind.__name__)  # not that of a base class
        self.path = Path(self.name)
        self.env_id = env_id
        self.sha256 = hash_modules(kind.__module__)

    def bind(self, setting: PolicyContext) -> None:
        """Check the setting of the env, and prepare for it. See `equip`.

        Raises:
            PolicyError: the task doesn't observe what the policy needs.
        """
        # Every baseline predicts the robot's motion from its velocities.
        numbers = (*self.needs, "linear_velocity", "angular_velocity")
        setting.need(self.name, numbers, *self.needs_in_words)
        self.equip(setting)

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task. Subclasses derive their own numbers here.

        Args:
            setting: What the policy may know of the env.
        """
        self.setting = setting
        self.units = RobotUnits.of(setting.config, setting.period)

        # Constants of the preset, if a search has found some.
        if defaults := type(self).constants:
            constants = find_constants(self.name, self.env_id, setting.config)
            self.constants = self.units.scale(defaults._replace(**constants))

    @abstractmethod
    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the velocity command of the next step.

        Args:
            seen: The observation, in SI units.

        Returns:
            Linear [m/s] and angular velocity [rad/s]. `__call__` clips them.
        """

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Choose the action for one observation, shape (2,) in [-1, 1]."""
        # Planners decide in SI units, actions are shares of the top speeds.
        linear, angular = self.act(self.setting.seen(observation))
        config = self.setting.config
        action = np.array((linear / config.max_linear, angular / config.max_angular), np.float32)
        return np.clip(action, -1.0, 1.0)
