"""The base class of policies that nobody trained."""

from __future__ import annotations

import hashlib
import inspect
import zlib
from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import MissingExtraError
from acsar_gym.jit import COMPILED
from acsar_gym.tasks import Observation
from acsar_gym.tools.baselines.tuning import TUNED, Constants, RobotUnits, find_constants
from acsar_gym.tools.policies.base import DecodedObservation, FilePolicy, PolicyContext

if TYPE_CHECKING:
    from acsar_gym.envs.base import RobotEnv


class BaselinePolicy(FilePolicy):
    """Base class of the baselines: they decide from the same observations as a trained policy.

    Beside them they know what any deployed policy may: the robot's config, the layout and scales
    of the task, and its period (`setting`).

    Args:
        env_id: id of the env that it drives.
    """

    name: ClassVar[str]
    """What `--policy` calls it."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of the task's numbers that it needs."""
    what: ClassVar[tuple[str, str]] = ("a goal", "point_goal")
    """What these are in words, and an env that has them."""
    lidar: ClassVar[bool] = False
    """Whether it needs a LiDAR."""
    compiled: ClassVar[bool] = False
    """Whether it is too slow without numba."""
    constants_type: ClassVar[type[Constants]] = Constants
    """Class of its constants."""
    env_named = True

    def __init__(self, env_id: str) -> None:
        self.path, self.env_id = Path(self.name), env_id
        source = inspect.getsourcefile(type(self)) or ""
        self.sha256 = hashlib.sha256(Path(source).read_bytes() + TUNED.read_bytes()).hexdigest()
        self._given: Constants | None = None
        self._env: RobotEnv | None = None
        self._rng: np.random.Generator | None = None

    def bind(self, env: RobotEnv) -> None:
        """Take the setting of the env.

        Raises:
            PolicyError: the task doesn't observe what the policy needs.
            MissingExtraError: it needs numba, which isn't installed.
        """
        if self.compiled and not COMPILED:
            raise MissingExtraError(f"the baseline {self.name}", "fast")
        setting = PolicyContext.of(env)
        setting.need(self.name, (*self.needs, "linear_velocity", "angular_velocity"), *self.what)
        if self.lidar:
            setting.need(self.name, (), "a LiDAR", "obstacle_goal")
        self._env = env
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
            seed = 0 if self._env is None else max(int(self._env.np_random_seed or 0), 0)
            self._rng = np.random.default_rng([zlib.crc32(self.name.encode()), seed])
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
