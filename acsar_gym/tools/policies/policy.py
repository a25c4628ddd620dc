"""Policies: their interface, those in Python, and observations by name in SI units."""

from __future__ import annotations

import hashlib
import importlib.util
import math
import re
import sys
import traceback
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, PolicyError, format_error, suggest_name
from acsar_gym.resources import AGENTS
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.sensors.map.sensor import MapSensor, find_map
from acsar_gym.tasks import Observation, Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.path import LENGTH_SCALE, LOOKAHEAD, POINT_TIME
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.policies.bundle import (
    Bundle,
    check_bundle,
    observation_scale,
    robot_differences,
    robots_outside,
)

if TYPE_CHECKING:
    from acsar_gym.envs.robot_env import RobotEnv

MAX_POLICY_BYTES = 32_000_000
"""Largest accepted ONNX file [bytes]; 8 million float32 weights."""
MAX_SOURCE_BYTES = 10_000_000
NO_POLICY = (
    "isn't a policy: must be an ONNX file, as 'acsar-gym train' and 'acsar-gym export' write it, "
    "or a zip of stable-baselines3"
)
GOAL_NUMBERS = ("goal_distance", "goal_cos", "goal_sin")
PATH_NUMBERS = ("cross_track_error", "heading_cos", "heading_sin", "remaining", "ahead_1", "left_1")
"""Names of the numbers that a policy may need of a task's observation."""


class Policy(Protocol):
    """A callable that maps one observation to one action."""

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Choose the action for one observation.

        Args:
            observation: float32, shape and range of the env's observation space.

        Returns:
            The action, shape (2,), within the env's action space.
        """


class FilePolicy(ABC):
    """Base class of the policies that are loaded from a file."""

    path: Path
    env_id: str
    """Id of the env that it was trained for; empty if the file doesn't name one."""
    env_named: bool = False
    """Whether `env_id` was given by the user (True) or by the file (False)."""
    bundle: Bundle | None = None
    """What the file says about the policy; None if it can't hold that, as Python code."""
    differences: tuple[str, ...] = ()
    """How the robot of the last `check` differs from those of the training, a line each."""
    outside: tuple[str, ...] = ()
    """Where the robot of the last `check` lies outside of those that it is for, a line each."""
    sha256: str | None = None
    """SHA-256 of the file's content, in hexadecimal as `sha256sum` prints it."""
    function: str | None = None
    """Name of the function, if the file is a Python file."""
    given: Any = None
    """The object itself, of a policy that is neither a file nor in a module."""
    act_many: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None
    """Maps observations (n, numbers) to actions (n, 2), where the policy has no memory."""
    privileged: bool = False
    """Whether it knows what only a simulator does, see `watch`."""

    @property
    def about(self) -> dict[str, str | None]:
        """What headers of results and recordings say about it."""
        return {
            "file": str(self.path),
            "sha256": self.sha256,
            "function": self.function,
            "env": self.env_id,
        }

    def check(
        self,
        task: Task,
        sensors: Sequence[Sensor],
        policy_rate: float | None = None,
        config: RobotConfig | None = None,
    ) -> None:
        """Check that the policy can drive in an env.

        Then `differences` has how its robot differs, and `outside` where it isn't one of those that
        the policy is for.

        A policy without a bundle fits every env.

        Args:
            task: task of the env.
            sensors: sensors of the env, in the order of the observation.
            policy_rate: policy steps per second of the env [Hz]; None to skip this check.
            config: of the robot; None to skip what depends on it.

        Raises:
            PolicyError: names the first field that doesn't match; see `bundle.check_bundle`.
        """
        if self.bundle is None:
            return
        try:
            check_bundle(self.bundle, task, sensors, config, policy_rate)
            if config is not None:
                self.outside = tuple(robots_outside(self.bundle, config))
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from error
        if config is not None:
            self.differences = tuple(robot_differences(self.bundle, sensors, config))

    @property
    def scale(self) -> float | None:
        """Length that distances in its observation are divided by [m]; None if unknown."""
        return None if self.bundle is None else self.bundle.observation.scale

    def bind(self, setting: PolicyContext) -> None:  # noqa: B027 - most policies need nothing of it
        """Take what the policy needs of what it will drive; by default nothing.

        Args:
            setting: of the env, which is made and checked for this policy, and not reset yet.
        """

    def watch(self, env: RobotEnv) -> None:  # noqa: B027 - most policies see observations alone
        """Take the env whose truth a `privileged` policy knows, after `bind`; by default nothing.

        Args:
            env: that it will drive.
        """

    def reset(self) -> None:  # noqa: B027 - most policies have no memory
        """Begin an episode, right after the env's reset; by default nothing changes."""

    @abstractmethod
    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Compute the deterministic action for one observation.

        Args:
            observation: float32, shape of the env's observation space.

        Returns:
            The action in [-1, 1], float32, shape (2,).
        """


def resolve(path: str | Path, baselines: Iterable[str] = ()) -> Path:
    """Find a policy file.

    Args:
        path: a file, or the name of a policy that comes with the package, such as "point_goal". A
            folder of this name doesn't hide it.
        baselines: names that the error tells, beside those of the packaged policies.

    Returns:
        Path of an existing file.

    Raises:
        PolicyError: there is neither a file nor a packaged policy of that name.
    """
    path = Path(path)
    packaged = AGENTS / "policies" / f"{path}.onnx"
    if packaged.exists() and not path.is_file():
        return packaged
    if path.exists():
        return path
    known = ", ".join(sorted(p.stem for p in packaged.parent.glob("*.onnx"))) or "none"
    others = f"; baselines: {', '.join(baselines)}" if baselines else ""
    raise PolicyError(f"{path}: no such policy file; policies that come along: {known}{others}")


@dataclass(frozen=True, slots=True)
class DecodedObservation:
    """One observation in SI units, in the base frame (x ahead, y to the left)."""

    linear: float = math.nan
    """Velocity by odometry [m/s]."""
    angular: float = math.nan
    """Yaw rate by odometry [rad/s]."""
    distance: float = math.nan
    """To the goal [m]; NaN without one."""
    bearing: float = math.nan
    """Of the goal, positive to the left [rad]."""
    ranges: Floats | None = None
    """(rays,): the newest scan [m]; None without a LiDAR."""
    cross_track: float = math.nan
    """Distance from the path [m], positive where the robot is to the left of it."""
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

    `evaluate`, `run` and `benchmark` give it to every policy that has a method `bind`, once for
    each env.
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
    """Where the LiDAR's ranges are in the observation; None without a LiDAR."""
    map: MapSensor | None = field(default=None, repr=False, compare=False)
    """The robot's map: where it is by odometry, what is occupied, the way to the goal; None without
    one. It changes with every step."""
    episode_seed: Callable[[], int | None] = field(default=lambda: None, repr=False, compare=False)
    """Returns the seed of the episode that has begun; None where it has none."""

    @classmethod
    def of(cls, env: RobotEnv) -> PolicyContext:
        """Read what a policy may know from an env.

        Args:
            env: of this package, made, and not closed.

        Returns:
            The setting of its policy.
        """
        config, task = env.robot.config, env.task
        first, rays = len(task.observation), None
        for sensor in env.sensors:
            if sensor.name == LIDAR:
                rays = slice(first, first + sensor.size)
            first += sensor.size
        return cls(
            config=config,
            task=task_name(task),
            period=env.ticks_per_step * config.period,
            tolerance=task.goal_tolerance,
            places={name: n for n, name in enumerate(task.observation)},
            scale=observation_scale(task),
            rays=rays,
            map=find_map(env.sensors),
            episode_seed=lambda: env.np_random_seed,
        )

    def rng(self, name: str) -> np.random.Generator:
        """Return a generator for the episode that has begun, so that results repeat.

        Args:
            name: of the policy: another one draws other numbers in the same episode.

        Returns:
            A new generator, seeded by the name and the episode's seed.
        """
        seed = max(int(self.episode_seed() or 0), 0)
        return np.random.default_rng([zlib.crc32(name.encode()), seed])

    def need(self, policy: str, names: tuple[str, ...], what: str, instead: str) -> None:
        """Check that the task observes what a policy needs.

        Args:
            policy: its name.
            names: of the numbers that it needs; () for the LiDAR.
            what: what they are in words, such as "a path".
            instead: an env that has it.

        Raises:
            PolicyError: it doesn't.
        """
        found = all(name in self.places for name in names) if names else self.rays is not None
        if not found:
            raise PolicyError(
                f"{policy}: needs {what}, which {self.task} doesn't observe: use --env {instead}, "
                "or another policy"
            )

    def seen(self, observation: Observation) -> DecodedObservation:
        """Take an observation apart, and convert it to SI units.

        Args:
            observation: of the env, float32 (n,).

        Returns:
            Its numbers; what the task doesn't observe under the names of this package's tasks is
            NaN or None.
        """
        numbers, config = observation.astype(np.float64), self.config
        at, scale = self.places, self.scale or 1.0
        told: dict[str, float | Floats | None] = {}
        if "linear_velocity" in at and "angular_velocity" in at:
            told["linear"] = numbers[at["linear_velocity"]] * config.max_linear
            told["angular"] = numbers[at["angular_velocity"]] * config.max_angular
        if "goal_distance" in at:
            told["distance"] = numbers[at["goal_distance"]] * scale
            told["bearing"] = math.atan2(numbers[at["goal_sin"]], numbers[at["goal_cos"]])
        if "cross_track_error" in at:
            told["cross_track"] = numbers[at["cross_track_error"]] * scale
            told["heading_error"] = math.atan2(
                numbers[at["heading_sin"]], numbers[at["heading_cos"]]
            )
            told["remaining"] = numbers[at["remaining"]] * LENGTH_SCALE
            first = at["ahead_1"]
            points = numbers[first : first + 2 * LOOKAHEAD].reshape(LOOKAHEAD, 2)
            told["points"] = points * (LOOKAHEAD * POINT_TIME * config.max_linear)
        if self.rays is not None:
            told["ranges"] = numbers[self.rays] * config.lidar.max_range
        return DecodedObservation(**told)  # type: ignore[arg-type]  # its own fields


_MODULE_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")


def is_callable(policy: Any) -> bool:
    """Return whether a policy argument means Python code: a file, a module, or an object.

    Args:
        policy: such as "mine.py", "mine.py:act", "mine.module:Planner", or anything but a text.
    """
    if not isinstance(policy, str):
        return True
    file = policy.endswith(".py") or policy.rpartition(":")[0].endswith(".py")
    return file or (_MODULE_NAME.fullmatch(policy) is not None and not Path(policy).exists())


class CallablePolicy(FilePolicy):
    """A policy in Python: a function, a class or an object, observation (n,) to action (2,).

    An object, of the class too, may have a state: `bind(setting)` is called once for each env, with
    its `PolicyContext`, and `reset()` at the begin of each episode, right after the env's reset.
    Loading one from a file or module runs its code.

    Args:
        policy: "FILE.py:NAME" or "module:NAME" of a function or class, or an object. A class is
            called without arguments, a `FilePolicy` such as a baseline with `env_id`.
        env_id: id of the env that it is for; by default the global ENV_ID of file or module, or
            the object's own `env_id`.

    Raises:
        PolicyError: there is no such file or name, its code raises an exception, no env is named,
            or (when called) the action isn't two finite numbers.
        ConfigError: there is no such module, or nothing of this name in it.
    """

    env_named = True
    """The user runs this code, so its ENV_ID is trusted."""

    def __init__(self, policy: Any, env_id: str = "") -> None:
        found: Any = policy
        module, self._source = None, ""
        if not isinstance(policy, str):
            self.given = policy
            self._name = getattr(policy, "__name__", type(policy).__name__)
            self.path = Path(self._name)
        elif _MODULE_NAME.fullmatch(policy) and not policy.rpartition(":")[0].endswith(".py"):
            with reading.find_modules_here():
                found = reading.import_object("policy", policy)
            self.path, self._name = Path(policy), policy.rpartition(":")[2]
            module = sys.modules[policy.partition(":")[0]]
            self._source = str(getattr(module, "__file__", None) or "")
            if self._source:
                self.sha256 = hashlib.sha256(Path(self._source).read_bytes()).hexdigest()
        else:
            name, _, self._name = (
                (policy, "", "") if policy.endswith(".py") else policy.rpartition(":")
            )
            self.path, self._source = Path(name), name
            source = reading.read_file(self.path, MAX_SOURCE_BYTES, PolicyError)
            self.sha256, self.function = hashlib.sha256(source).hexdigest(), self._name
            module = self._run_source(source)
            found = getattr(module, self._name, None) if self._name else None
        if not callable(found):
            known = [n for n, one in vars(module).items() if callable(one) and n[:1] != "_"]
            named = f"has no function {self._name!r}" if self._name else "name a function of it"
            hint = suggest_name(self._name, known) if known else ""
            raise PolicyError(f"{self.path}: {named}, as in {self.path.name}:act{hint}")
        self.said_id = str(getattr(module, "ENV_ID", "") or getattr(found, "env_id", ""))
        """The id that the code itself names; empty if it names none."""
        self.env_id = env_id or self.said_id
        if not self.env_id:
            raise PolicyError(
                f"{self.path}: doesn't say which environment it is for: pass --env point_goal or "
                "another, or set ENV_ID in it"
            )
        if isinstance(found, type):
            arguments = (self.env_id,) if issubclass(found, FilePolicy) else ()
            found = self._call("can't be made", found, *arguments)
            if not callable(found):
                raise PolicyError(f"{self.path}: {self._name} has no method __call__")
        self._act: Any = found

    def bind(self, setting: PolicyContext) -> None:
        """Call the object's own `bind`, if it has one; PolicyError where that raises an error."""
        if (bind := getattr(self._act, "bind", None)) is not None:
            self._call("bind failed", bind, setting)

    def reset(self) -> None:
        """Call the object's own `reset`, if it has one; PolicyError where that raises an error."""
        if (reset := getattr(self._act, "reset", None)) is not None:
            self._call("reset failed", reset)

    def _run_source(self, source: bytes) -> ModuleType:
        """Run the file's source as a module."""
        name = f"acsar_gym_policy_{self.path.stem}"
        spec = importlib.util.spec_from_file_location(name, self.path)
        if spec is None:
            raise PolicyError(f"{self.path}: not a Python file")
        module = importlib.util.module_from_spec(spec)
        folder = str(self.path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)  # the file may import modules of its own folder
        sys.modules[name] = module  # dataclasses and pickle look modules up there

        def run() -> None:
            exec(compile(source, self.path, "exec"), module.__dict__)  # noqa: S102 - named by the user

        self._call("can't be run", run)
        return module

    def _call(self, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call the user's code; PolicyError with the line of the file where it raises an error."""
        try:
            return function(*arguments)
        except AcsarError:
            raise
        except (Exception, SystemExit) as error:
            frames = traceback.extract_tb(error.__traceback__)
            lines = [f.lineno for f in frames if f.filename == self._source]
            line = getattr(error, "lineno", None) or (lines[-1] if lines else 0)
            where = f"{self.path}, line {line}" if line else f"{self.path}"
            raise PolicyError(f"{where}: {what}: {format_error(error)}") from error

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Call the function; returns its action, shape (2,).

        Raises:
            PolicyError: the function raises an exception, or gives anything but two finite
                numbers.
        """
        given = self._call(f"{self._name} failed", self._act, observation)
        try:
            action = np.asarray(given, np.float32)
        except Exception:  # noqa: BLE001 - torch has errors of its own for tensors with gradients
            action = np.full(0, np.nan, np.float32)
        if action.shape != (2,) or not np.isfinite(action).all():
            said = repr(given).replace("\n", " ")[:100]
            raise PolicyError(f"{self.path}: {self._name} gave {said}: must be two finite numbers")
        return action
