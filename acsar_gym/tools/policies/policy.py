"""The interface of policies, and what a deployed policy may know of robot and task."""

from __future__ import annotations

import math
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import PolicyError
from acsar_gym.resources import AGENTS
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.sensors.map.sensor import MapSensor, find_map
from acsar_gym.tasks import Observation, Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.path import LENGTH_SCALE, LOOKAHEAD, POINT_TIME
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.policies.document import observation_scale

if TYPE_CHECKING:
    from acsar_gym.envs.robot_env import RobotEnv

Actions = NDArray[np.float32]
GOAL_NUMBERS = ("goal_distance", "goal_cos", "goal_sin")
"""Names of the numbers of a goal among a task's."""
PATH_NUMBERS = ("cross_track_error", "heading_cos", "heading_sin", "remaining", "ahead_1", "left_1")
"""Names of the numbers of a path."""


class Policy(Protocol):
    """A callable that maps one observation to one action."""

    def __call__(self, observation: Observation) -> Actions:
        """Choose the action for one observation.

        Args:
            observation: float32, shape and range of the env's observation space.

        Returns:
            The action, shape (2,), within the env's action space.
        """


class FilePolicy(ABC):
    """Base class of policies, most of which are loaded from a file."""

    path: Path
    env_id: str
    """Id of the env that it was trained for. Empty if that isn't known."""
    env_named: bool = False
    """Whether the user named `env_id`, and not the file."""
    anyway: bool = False
    """Whether it may drive real robots of another size or speed than those of its training."""
    differences: tuple[str, ...] = ()
    """How task and robot of the last `check` differ from the training, as lines for people."""
    outside: tuple[str, ...] = ()
    """In which size and speed the robot of the last `check` is outside of the training."""
    scale: float | None = None
    """Length that distances in its observation are divided by [m]. None if not known."""
    sha256: str | None = None
    """SHA-256 of the file's content, as `sha256sum` prints it."""
    function: str | None = None
    """Name of the function, if the file is a Python file."""
    instance: Any = None
    """The object itself, of a policy that is neither a file nor in a module."""
    act_many: Callable[[Actions], Actions] | None = None
    """Maps observations (n, numbers) to actions (n, 2), if the policy has no memory."""
    privileged: bool = False
    """Whether it knows what only a simulator does, see `watch`."""

    @property
    def about(self) -> dict[str, str | None]:
        """What the headers of results and recordings contain."""
        return {
            "file": str(self.path),
            "sha256": self.sha256,
            "function": self.function,
            "env": self.env_id,
        }

    def check(  # noqa: B027 - a policy without a document fits every env
        self,
        task: Task,
        sensors: Sequence[Sensor],
        policy_rate: float | None = None,
        config: RobotConfig | None = None,
    ) -> None:
        """Check that the policy can drive in an env, and set `differences` and `outside`.

        Args:
            task: Task of the env.
            sensors: Sensors of the env, in the order of the observation.
            policy_rate: Policy steps per second of the env [Hz]. None to skip this check.
            config: Robot of the env. None to skip its comparison.

        Raises:
            PolicyError: Observation or rate differ.
        """

    def bind(self, setting: PolicyContext) -> None:  # noqa: B027 - most policies need nothing of it
        """Give the policy robot and task of its env. By default it ignores them.

        Args:
            setting: Robot and task of the env, which isn't reset yet.
        """

    def watch(self, env: RobotEnv) -> None:  # noqa: B027 - most policies see observations only
        """Give a `privileged` policy access to the env, after `bind`. By default it ignores it.

        Args:
            env: The env that it will drive.
        """

    def reset(self) -> None:  # noqa: B027 - most policies have no memory
        """Start an episode, right after the env's reset. By default nothing changes."""

    @abstractmethod
    def __call__(self, observation: Observation) -> Actions:
        """Compute the deterministic action for one observation.

        Args:
            observation: float32, shape of the env's observation space.

        Returns:
            The action in [-1, 1], float32, shape (2,).
        """


def resolve(path: str | Path, baselines: Iterable[str] = ()) -> Path:
    """Find a policy file.

    Args:
        path: A file, or the name of a packaged policy, such as "point_goal". A folder of this name
            doesn't hide it.
        baselines: Names that the error lists in addition to the packaged policies.

    Returns:
        Path of an existing file.

    Raises:
        PolicyError: There is neither a file nor a packaged policy of that name.

    Example:
        from acsar_gym.tools.policies import resolve

        assert resolve("point_goal").suffix == ".onnx"
    """
    path = Path(path)
    # A folder such as crowd/ would hide the packaged policy of this name.
    folder = AGENTS / "policies"
    packaged = folder / f"{path}.onnx"
    if packaged.exists() and not path.is_file():
        return packaged
    if path.exists():
        return path
    names = ", ".join(sorted(p.stem for p in folder.glob("*.onnx"))) or "none"
    more = f"; baselines: {', '.join(baselines)}" if baselines else ""
    raise PolicyError(f"{path}: no such policy file; packaged policies: {names}{more}")


@dataclass(frozen=True, slots=True)
class DecodedObservation:
    """One observation in SI units, in the base frame (x ahead, y to the left)."""

    linear: float = math.nan
    """Velocity by odometry [m/s]."""
    angular: float = math.nan
    """Yaw rate by odometry [rad/s]."""
    distance: float = math.nan
    """To the goal [m]. NaN without one."""
    bearing: float = math.nan
    """Of the goal, positive to the left [rad]."""
    ranges: Floats | None = None
    """(rays,): the newest scan [m]. None without a LiDAR."""
    cross_track: float = math.nan
    """Distance from the path [m], positive if the robot is to the left of it."""
    heading_error: float = math.nan
    """Heading minus the path's direction [rad]."""
    remaining: float = math.nan
    """Length of the path ahead [m]."""
    points: Floats | None = None
    """(4, 2): points of the path ahead [m]."""

    @property
    def goal(self) -> tuple[float, float]:
        """The goal (x, y) in the base frame [m]."""
        return self.distance * math.cos(self.bearing), self.distance * math.sin(self.bearing)


@dataclass(frozen=True)
class PolicyContext:
    """Robot, period and layout of the observation: what a deployed policy may know.

    `evaluate`, `run` and `benchmark` pass it to every policy that has a method `bind`, once for
    each env.

    Example:
        import gymnasium
        import acsar_gym
        from acsar_gym.tools.policies.policy import PolicyContext

        env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar")
        assert PolicyContext.of(env.unwrapped).period == 0.1
        env.close()
    """

    config: RobotConfig
    """The robot."""
    task: str
    """Name of the task, for messages."""
    period: float
    """Time between two decisions [s]."""
    tolerance: float
    """Distance from the goal that counts as success [m]."""
    places: dict[str, int]
    """Index of each of the task's numbers in the observation."""
    scale: float | None
    """What distances are divided by [m]."""
    rays: slice | None
    """Where the LiDAR's ranges are in the observation. None without a LiDAR."""
    map: MapSensor | None = field(default=None, repr=False, compare=False)
    """The robot's map, which changes with every step. None without one."""
    episode_seed: Callable[[], int | None] = field(default=lambda: None, repr=False, compare=False)
    """Returns the seed of the current episode. None if it has none."""

    @classmethod
    def of(cls, env: RobotEnv) -> PolicyContext:
        """Read what a policy may know from an env.

        Args:
            env: An env of this package, which isn't closed.

        Returns:
            The setting of its policy.
        """
        # The sensors' numbers follow those of the task, in their order.
        task = env.task
        rays = None
        first = len(task.observation)
        for sensor in env.sensors:
            if sensor.name == LIDAR:
                rays = slice(first, first + sensor.size)
            first += sensor.size

        return cls(
            config=env.robot.config,
            task=task_name(task),
            period=env.ticks_per_step * env.robot.config.period,
            tolerance=task.goal_tolerance,
            places={name: place for place, name in enumerate(task.observation)},
            scale=observation_scale(task),
            rays=rays,
            map=find_map(env.sensors),
            episode_seed=lambda: env.np_random_seed,
        )

    def rng(self, name: str) -> np.random.Generator:
        """Return a generator for the current episode, so that results repeat.

        Args:
            name: Name of the policy. Policies of other names draw other numbers.

        Returns:
            A new generator, seeded by the name and the episode's seed.
        """
        # A CRC, as hash() of a text differs from process to process.
        seed = max(int(self.episode_seed() or 0), 0)
        return np.random.default_rng([zlib.crc32(name.encode()), seed])

    def need(self, policy: str, names: tuple[str, ...], what: str, instead: str) -> None:
        """Check that the task observes what a policy needs.

        Args:
            policy: Name of the policy.
            names: Names of the numbers that it needs, () for the LiDAR.
            what: What they are in words, such as "a path".
            instead: An env that has it.

        Raises:
            PolicyError: The task doesn't observe it.
        """
        # Without names it is the LiDAR that is needed.
        has_numbers = all(name in self.places for name in names)
        if not (has_numbers and (names or self.rays is not None)):
            raise PolicyError(
                f"{policy}: needs {what}, which {self.task} doesn't observe: use --env {instead}, "
                "or another policy"
            )

    def seen(self, observation: Observation) -> DecodedObservation:
        """Take an observation apart, and convert it to SI units.

        Args:
            observation: float32 (n,), of the env.

        Returns:
            Its numbers. NaN or None for what the task doesn't observe under the names of this
            package's tasks.
        """
        numbers = observation.astype(np.float64)
        named = {name: float(numbers[place]) for name, place in self.places.items()}
        scale = self.scale or 1.0
        decoded: dict[str, Any] = {}

        # Only what the task observes under the names of this package's tasks.
        if {"linear_velocity", "angular_velocity"} <= named.keys():
            decoded["linear"] = named["linear_velocity"] * self.config.max_linear
            decoded["angular"] = named["angular_velocity"] * self.config.max_angular
        if "goal_distance" in named:
            decoded["distance"] = named["goal_distance"] * scale
            decoded["bearing"] = math.atan2(named["goal_sin"], named["goal_cos"])
        if "cross_track_error" in named:
            decoded["cross_track"] = named["cross_track_error"] * scale
            decoded["heading_error"] = math.atan2(named["heading_sin"], named["heading_cos"])
            decoded["remaining"] = named["remaining"] * LENGTH_SCALE
            first = self.places["ahead_1"]
            points = numbers[first : first + 2 * LOOKAHEAD].reshape(LOOKAHEAD, 2)
            decoded["points"] = points * (LOOKAHEAD * POINT_TIME * self.config.max_linear)
        if self.rays is not None:
            decoded["ranges"] = numbers[self.rays] * self.config.lidar.max_range
        return DecodedObservation(**decoded)
