"""The base class of policies that nobody trained."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
from abc import abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from acsar_gym.tasks import Observation
from acsar_gym.tools.baselines.tuning import TUNED, Constants, RobotUnits, find_constants
from acsar_gym.tools.policies.policy import DecodedObservation, FilePolicy, PolicyContext


class BaselinePolicy(FilePolicy):
    """Base class of the baselines: they decide from the same observations as a trained policy.

    Beside them they know what any deployed policy may: the robot's config, the layout and scales
    of the task, and its period (`setting`). A subclass of another package is named with its module,
    as in `--policy mine.module:Planner`; it has `act`, and `reset` where it remembers something.

    Args:
        env_id: id of the env that it drives.
    """

    name: ClassVar[str]
    """What messages call it, and `--policy` those of this package; by default that of the class."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of the task's numbers that it needs."""
    what: ClassVar[tuple[str, str]] = ("a goal", "point_goal")
    """What these are in words, and an env that has them."""
    lidar: ClassVar[bool] = False
    """Whether it needs a LiDAR."""
    constants_type: ClassVar[type[Constants]] = Constants
    """Class of its constants."""
    env_named = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "name" not in vars(cls):
            cls.name = cls.__name__

    def __init__(self, env_id: str) -> None:
        self.path, self.env_id = Path(self.name), env_id
        with contextlib.suppress(TypeError, OSError):  # there is no file in a notebook
            source = Path(inspect.getsourcefile(type(self)) or "")
            self.sha256 = hashlib.sha256(source.read_bytes() + TUNED.read_bytes()).hexdigest()
        self._given: Constants | None = None
        self._rng: np.random.Generator | None = None

    def bind(self, setting: PolicyContext) -> None:
        """Check the setting of the env, and prepare for it; see `equip`.

        Raises:
            PolicyError: the task doesn't observe what the policy needs.
        """
        setting.need(self.name, (*self.needs, "linear_velocity", "angular_velocity"), *self.what)
        if self.lidar:
            setting.need(self.name, (), "a LiDAR", "obstacle_goal")
        self.equip(setting)

    def use_constants(self, given: Constants | None) -> None:
        """Decide with these constants from the next `equip` on, as a search does.

        Args:
            given: of its `constants_type`; None for those that are known for the robot.
        """
        self._given = given

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task; subclasses derive their own numbers here.

        Args:
            setting: of the env.
        """
        self.setting = setting
        self.units = RobotUnits.of(setting.config, setting.period)
        self.constants: Any = self._given or find_constants(
            self.constants_type, self.name, self.env_id, setting.config
        )

    def reset(self) -> None:
        """Begin an episode; subclasses forget the last one here."""
        self._rng = None

    @property
    def rng(self) -> np.random.Generator:
        """The generator of this episode, seeded like the env's, so that results repeat."""
        if self._rng is None:
            self._rng = self.setting.rng(self.name)
        return self._rng

    @abstractmethod
    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the velocity command of the next step.

        Args:
            seen: the observation, in SI units.

        Returns:
            Linear [m/s] and angular velocity [rad/s]; `__call__` clips them.
        """

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Choose the action for one observation, shape (2,) in [-1, 1]."""
        linear, angular = self.act(self.setting.seen(observation))
        config = self.setting.config
        action = np.array((linear / config.max_linear, angular / config.max_angular), np.float32)
        return np.clip(action, -1.0, 1.0)
