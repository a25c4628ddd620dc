"""Sensors written in Python, in a batch: they run over all robots after the compiled physics.

The LiDAR isn't among them: it is compiled. `View` has what a sensor can know of its robot: ground
truth, time and scene.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError, LinkError, show_value, translate_errors
from acsar_gym.jit import overloads
from acsar_gym.links.base import Link
from acsar_gym.sensors import LIDAR, MAP, MOVERS, Factory, Sensor, Truths, draw_uniform
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.sensors.sensor import name_memory
from acsar_gym.sensors.suite import (
    add_sensor_info,
    check_info_key,
    check_names,
    check_numbers,
    make_sensor,
    naming_sensor,
    sensor_factories,
)
from acsar_gym.tasks.task import is_compiled
from acsar_gym.truth import GroundTruth
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.kernel.binding import (
    bind_methods,
    explain_error,
    is_compile_error,
    numbers_of,
)
from acsar_gym.vector.pcg import Generators, Lent, LentGenerators, uniform
from acsar_gym.worlds import Scene, World

Floats = NDArray[np.float64]
Observations = NDArray[np.float32]
"""(robots, numbers): the columns of the observations that these sensors fill."""
Robots = NDArray[np.int64]  # indices of robots in the batch
START = ("start_x", "start_y", "start_theta")
DIRECTION = ("start_cos", "start_sin")
BATCH_METHODS = ("reset_batch", "read_batch")
"""The methods that a batch compiles where a sensor is compiled."""
COMPILED_RULES = (
    "a compiled sensor has no scenes, link or config, and draws by draw_uniform or draw_normal: "
)


@overloads(draw_uniform)
def _draw_from_row(rngs: Any, i: Any) -> Callable[..., float]:
    """Replacement for `draw_uniform` in compiled sensors, whose `rngs` are rows of `Generators`."""

    def draw(rngs: Any, i: Any) -> float:
        return uniform(rngs, i)

    return draw


class BatchView:
    """What sensors may know of all robots of a batch. `random` are the robots' generators."""

    def __init__(
        self, numbers: Floats, random: Generators, dt: float, worlds: Sequence[World]
    ) -> None:
        self.random = random
        self._numbers, self._dt, self._worlds = numbers, dt, worlds

    def _read(self, robots: Robots, *names: str) -> Floats:
        """Fields of these robots, (numbers, robots)."""
        return layout.read_fields(self._numbers, names, robots)

    def truths(self, robots: Robots) -> Truths:
        """Ground truth of these robots, in the frames of their worlds."""
        x, y, heading, vx, vy, rate, contact = self._read(
            robots, "x", "y", "theta", "vx", "vy", "rate", "contact"
        )
        start_x, start_y, start_theta, cos, sin = self._read(robots, *START, *DIRECTION)
        theta = start_theta + heading
        theta -= layout.TURN * np.rint(theta / layout.TURN)
        pose = [start_x + cos * x - sin * y, start_y + sin * x + cos * y, theta]
        twist = [vx * np.cos(heading) + vy * np.sin(heading), rate]
        return Truths(np.column_stack(pose), np.column_stack(twist), contact > 0.0)

    def now(self, robots: Robots) -> Floats:
        """Simulated time since these robots' links were reset [s], (robots,)."""
        time: Floats = self._read(robots, "loops")[0] * self._dt
        return time

    def scenes(self, robots: Robots) -> list[Scene]:
        """World, start and goal of these robots' episodes, in the frames of the worlds."""
        rows = self._read(robots, *START, "goal_x", "goal_y", "world")
        scenes = []
        for x, y, theta, ahead, left, number in rows.T.tolist():
            cos, sin = math.cos(theta), math.sin(theta)
            goal = (x + cos * ahead - sin * left, y + sin * ahead + cos * left)
            world = self._worlds[int(number)] if self._worlds else None
            scenes.append(Scene((x, y, theta), goal, world))
        return scenes


class RobotLink(Link):
    """The link that a sensor of a batch gets: it has ground truth and time, but no wire."""

    def __init__(self, view: BatchView, robot: int) -> None:
        self._view = view
        self._robots = np.array([robot])

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of its world."""
        (x, y, theta), (forward, rate), contact = (
            array[0].tolist() for array in self._view.truths(self._robots)
        )
        return GroundTruth((x, y, theta), (forward, rate), contact)

    def now(self) -> float:
        """Simulated time since the reset [s]."""
        return float(self._view.now(self._robots)[0])

    def open(self) -> None:
        """Do nothing: there is no device."""

    def reset(self, scene: Scene) -> None:
        """Do nothing: the batch resets its robots."""

    def close(self) -> None:
        """Do nothing: there is no device."""

    def write(self, data: bytes) -> NoReturn:
        """Raise LinkError: robots of a batch have no wire."""
        raise LinkError("a robot of a batch has no wire", "use the single env")

    def advance(self, period: float) -> NoReturn:
        """Raise LinkError: robots of a batch have no wire."""
        raise LinkError("a robot of a batch has no wire", "use the single env")


class Moment(NamedTuple):
    """What the sensors of some robots are given at one time, one row or item for each robot."""

    robots: list[int]
    truths: Truths
    now: Floats
    scenes: Sequence[Scene]
    rngs: LentGenerators

    def each(self) -> Iterator[tuple[int, GroundTruth, float]]:
        """Index, ground truth and time [s] of each robot, as in the single env."""
        rows = (self.robots, *(array.tolist() for array in (*self.truths, self.now)))
        for robot, pose, twist, contact, now in zip(*rows, strict=True):
            yield robot, GroundTruth(tuple(pose), tuple(twist), contact), now


class BatchSensors:
    """The sensors of all robots of a batch, except the LiDAR.

    Attributes: `kinds`, one instance of each; `size`, their numbers in the observation; `clocked`,
    whether any of them must be polled after every tick; `info`, an array for each key of theirs.
    """

    def __init__(
        self,
        wanted: Iterable[Sensor | Factory],
        fleet: Sequence[RobotConfig],
        robots: int,
        view: BatchView,
    ) -> None:
        self._view = view
        self._groups = [_group(factory, fleet, robots, view) for factory in wanted]
        self.kinds: list[Sensor] = [group.kind for group in self._groups]
        check_names([kind.name for kind in self.kinds])
        self.clocked = any(overrides(kind, "poll") for kind in self.kinds)
        self.size = sum(kind.size for kind in self.kinds)
        self.info: dict[str, Floats] = {}
        self._scenes = [Scene()] * robots
        self._generators: dict[int, Lent] = {}

    def __len__(self) -> int:
        return len(self._groups)

    def add_info(self, info: dict[str, Floats]) -> None:
        """Add the sensors' info to the batch's. ConfigError for a key that is there already."""
        if self.info:
            for group in self._groups:
                for key in group.keys:
                    check_info_key(info, group.kind, key)
            info |= self.info

    def forget(self, robot: int) -> None:
        """Drop the NumPy generator of a robot that has been seeded anew."""
        self._generators.pop(robot, None)

    def reset(self, robots: Robots, observations: Observations) -> None:
        """Reset the sensors of robots that begin an episode, and read them."""
        if len(robots) == 0:
            return
        for robot, scene in zip(robots.tolist(), self._view.scenes(robots), strict=True):
            self._scenes[robot] = scene
        with self._moment(robots) as moment:
            for group in self._groups:
                group.reset(moment)
            self._read(moment, observations)

    def poll(self, robots: Robots) -> None:
        """Poll the sensors of these robots after a tick."""
        with self._moment(robots) as moment:
            for group in self._groups:
                group.poll(moment)

    def read(self, robots: Robots, observations: Observations) -> None:
        """Read the sensors of these robots after the last tick of a step; as `reset`."""
        with self._moment(robots) as moment:
            self._read(moment, observations)

    def _read(self, moment: Moment, observations: Observations) -> None:
        """Write what the sensors read into the observations, and their info."""
        first = 0
        told: dict[str, list[float]] = {}
        for group in self._groups:
            out = np.full((len(moment.robots), group.kind.size), np.nan)
            group.read(moment, out)
            observations[moment.robots, first : first + group.kind.size] = out
            first += group.kind.size
            group.tell(moment, told)
        for key, values in told.items():  # in new arrays: those that a user has don't change
            array = self.info[key].copy() if key in self.info else np.zeros(len(self._scenes))
            array[moment.robots] = values
            self.info[key] = array

    @contextlib.contextmanager
    def _moment(self, robots: Robots) -> Iterator[Moment]:
        """What the sensors are given now; generators are lent to them inside the block."""
        numbers = robots.tolist()
        whole = len(numbers) == len(self._scenes)
        scenes = self._scenes if whole else [self._scenes[robot] for robot in numbers]
        rngs = LentGenerators(self._view.random, numbers, self._generators)
        try:
            truths, now = self._view.truths(robots), self._view.now(robots)
            yield Moment(numbers, truths, now, scenes, rngs)
        finally:
            rngs.give_back()


class _Each:
    """One sensor object for each robot, as in the single env."""

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        self.kind = sensors[0]
        self._sensors = sensors
        self._polled = overrides(self.kind, "poll")
        self._tells = overrides(self.kind, "info")
        self.keys: list[str] = []

    def _for_each(
        self, moment: Moment, call: Callable[[int, Sensor, GroundTruth, float], None]
    ) -> None:
        """Call a function with place, sensor, ground truth and time of each robot.

        Errors name the sensor and the robot.
        """
        at = 0
        with translate_errors(AcsarError, lambda: f"sensor {self.kind.name!r} of robot {at}"):
            for place, (robot, truth, now) in enumerate(moment.each()):
                at = robot
                call(place, self._sensors[robot], truth, now)

    def reset(self, moment: Moment) -> None:
        """Reset them; those with a clock of their own take a first measurement."""

        def begin(place: int, sensor: Sensor, truth: GroundTruth, now: float) -> None:
            sensor.reset(moment.scenes[place], moment.rngs[place])
            if self._polled:
                sensor.poll(truth, now)

        self._for_each(moment, begin)

    def poll(self, moment: Moment) -> None:
        """Poll those with a clock of their own."""
        if self._polled:
            list(moment.rngs)  # generators that sensors keep go on at the batch's current states
            self._for_each(moment, lambda _, sensor, truth, now: sensor.poll(truth, now))

    def read(self, moment: Moment, out: Floats) -> None:
        """Read them into `out`, (robots, size)."""
        list(moment.rngs)

        def read(place: int, sensor: Sensor, truth: GroundTruth, now: float) -> None:
            out[place] = check_numbers(sensor, sensor.read(truth, now))

        self._for_each(moment, read)

    def tell(self, moment: Moment, told: dict[str, list[float]]) -> None:
        """Add their info, one number for each robot. ConfigError for a key that is there."""
        if not self._tells:
            return
        each: list[dict[str, float]] = [{} for _ in moment.robots]
        self._for_each(
            moment, lambda place, sensor, _, now: add_sensor_info(each[place], sensor, now)
        )
        self.keys = list(each[0]) if each else self.keys
        for key in self.keys if each else ():
            check_info_key(told, self.kind, key)
            told[key] = [info[key] for info in each]


class _Whole:
    """One sensor object whose `read_batch` and `reset_batch` are called for all robots at once."""

    keys: Sequence[str] = ()

    def __init__(self, sensor: Any, robots: int, random: Generators) -> None:
        self.kind, self._random = sensor, random
        first = np.array(list(sensor.memory.values()), np.float64)
        self._first = first.reshape(-1, 1)
        self._memory = self._first.repeat(robots, axis=1)
        """(names, robots)."""
        self._compiled = is_compiled(sensor, BATCH_METHODS)
        self._reset: Any = getattr(sensor, "reset_batch", None)
        self._read: Any = sensor.read_batch
        if self._compiled:
            with naming_sensor(sensor):
                numbers = numbers_of(sensor)
            if self._reset is not None:
                self._reset = partial(bind_method(type(sensor), "reset_batch"), numbers)
            self._read = partial(bind_method(type(sensor), "read_batch"), numbers)

    @contextlib.contextmanager
    def _given(self, moment: Moment) -> Iterator[tuple[Any, Any, tuple[Any, ...]]]:
        """The scenes, generators and memory of some robots; what is done to the latter is kept."""
        kept = self._memory.take(moment.robots, axis=1)
        memory = name_memory(self.kind, kept)
        if self._compiled:
            moment.rngs.give_back()
            rows = self._random[moment.robots]
            with _explaining_numba(self.kind):
                yield None, rows, memory
            self._random[moment.robots] = rows
        else:
            with naming_sensor(self.kind):
                yield moment.scenes, moment.rngs, memory
        self._memory[:, moment.robots] = kept

    def reset(self, moment: Moment) -> None:
        """Begin episodes: the memory gets its first values, then those of `reset_batch`."""
        self._memory[:, moment.robots] = self._first
        if self._reset is not None:
            with self._given(moment) as (scenes, rngs, memory):
                self._reset(scenes, rngs, *memory)

    def poll(self, moment: Moment) -> None:
        """Do nothing: such a sensor has no clock of its own."""

    def read(self, moment: Moment, out: Floats) -> None:
        """Read all robots into `out`, (robots, size). AcsarError where it isn't finite."""
        with self._given(moment) as (scenes, rngs, memory):
            self._read(moment.truths, scenes, moment.now, rngs, out, *memory)
        sound = np.isfinite(out).all(axis=1)
        if not sound.all():
            place = int(sound.argmin())
            raise AcsarError(
                f"sensor {self.kind.name!r}: read_batch() left "
                f"{show_value(out[place].tolist())} for "
                f"robot {moment.robots[place]}: must be finite numbers"
            )

    def tell(self, moment: Moment, told: dict[str, list[float]]) -> None:
        """Do nothing: such a sensor has no info."""


def bind_method(kind: type, name: str) -> Callable[..., None]:
    """Compile a method of a sensor's class; it gets the sensor's numbers as `self`."""
    return bind_methods(kind, call_method, {"sensor_method": name})


sensor_method: Any = None
"""Placeholder: in the copies of `call_method` that `bind_methods` makes, a compiled method."""


def call_method(sensor: Any, *arguments: Any) -> None:
    """Call a method of a sensor."""
    sensor_method(sensor, *arguments)


@contextlib.contextmanager
def _explaining_numba(sensor: Sensor) -> Iterator[None]:
    """Make errors of one line from those of a compiled sensor."""
    named = f"sensor {sensor.name!r}"
    try:
        yield
    except Exception as error:
        if is_compile_error(error):
            kind = type(sensor)
            raise explain_error(named, kind, BATCH_METHODS, error, COMPILED_RULES) from error
        raise AcsarError(
            f"{named}: {type(error).__name__}: {error}, in a compiled method; "
            "with compiled = False, the line is told"
        ) from error


def python_sensors(sensors: Sequence[str | Sensor | Factory]) -> list[Sensor | Factory]:
    """Factories of the sensors of a batch that aren't compiled: not LiDAR, map and movers."""
    names = LIDAR, MAP, MOVERS
    compiled = [sensor for sensor in sensors if isinstance(sensor, str) and sensor in names]
    check_names(compiled)
    if MAP in compiled and LIDAR not in compiled:
        raise ConfigError("sensor 'map': the robot has no 'lidar', which it needs")
    if MOVERS in compiled and MAP not in compiled:
        raise ConfigError("sensor 'movers': the robot has no 'map', which it needs")
    others = [sensor for sensor in sensors if sensor not in compiled]
    return sensor_factories(others)


def _group(
    factory: Any, fleet: Sequence[RobotConfig], robots: int, view: BatchView
) -> _Each | _Whole:
    """Make the sensors of one factory for all robots. ConfigError where a batch can't use them.

    One that has `read_batch` is made for the first robot of a fleet.
    """
    one = make_sensor(factory, RobotLink(view, 0), fleet[0])
    if one.name == LIDAR or isinstance(one, LidarSensor):
        raise ConfigError(
            f"sensor {one.name!r}: a batch has no LiDAR but its own: name it {LIDAR!r} in sensors"
        )
    if hasattr(one, "read_batch"):
        if any(overrides(one, method) for method in ("reset", "poll", "info")):
            raise ConfigError(
                f"sensor {one.name!r}: has read_batch, so reset, poll and info aren't used in a "
                "batch: leave them away, and begin episodes in reset_batch"
            )
        return _Whole(one, robots, view.random)
    if one is factory:
        raise ConfigError(
            f"sensor {one.name!r}: a batch needs one for each robot: pass its class or a factory"
        )
    sensors = [one]
    for robot in range(1, robots):
        made = make_sensor(factory, RobotLink(view, robot), fleet[robot % len(fleet)])
        if made.size != one.size:
            raise ConfigError(
                f"sensor {one.name!r}: has {one.size} numbers for robot 0 of the fleet and "
                f"{made.size} for robot {robot}: must have as many for all"
            )
        sensors.append(made)
    return _Each(sensors)


def overrides(sensor: Sensor, method: str) -> bool:
    """Whether the sensor's class overrides a method of `Sensor`."""
    return getattr(type(sensor), method) is not getattr(Sensor, method)
