"""Sensors of users in a batch: they read all robots at once, after the compiled physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.jit import overloads
from acsar_gym.links import open_link
from acsar_gym.sensors import Factory, Sensor, SensorInput, draw_uniform
from acsar_gym.sensors.sensor import SENSOR_METHODS, name_memory, new_memory
from acsar_gym.sensors.suite import (
    BUILT_IN,
    check_finite,
    check_new_key,
    is_polled,
    make_sensors,
    naming_sensor,
    sensor_factories,
)
from acsar_gym.tasks.task import is_compiled
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.kernel.binding import bind_methods, name_error, numbers_of
from acsar_gym.vector.pcg import LentGenerators, uniform
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.world import point_in_world

Floats = NDArray[np.float64]
Places = NDArray[np.int64]
"""Numbers of some robots of the batch."""
SENSED_FIELDS = (
    *("start_x", "start_y", "start_theta", "start_cos", "start_sin"),
    *("true_x", "true_y", "theta", "vx", "vy", "rate", "true_contact", "loops"),
)
"""Fields of `layout.Robots` that a `SensorInput` is made of."""


@overloads(draw_uniform)
def _draw_from_row(rngs: Any, i: Any) -> Callable[..., float]:
    """Replacement for `draw_uniform` in compiled sensors, whose `rngs` are rows of `Generators`."""

    def draw(rngs: Any, i: Any) -> float:
        return uniform(rngs, i)

    return draw


def make_batch_sensors(
    wanted: Sequence[str | Sensor | Factory], config: RobotConfig, step: float
) -> list[Sensor]:
    """Make the sensors of a batch, in the order of their numbers in the observation.

    Raises:
        ConfigError: A batch can't have such a sensor.
    """
    factories = sensor_factories(wanted, period=step)
    # Factories expect a link. A batch has none, so a closed planar link replaces it.
    sensors = make_sensors(factories, open_link("planar", config), config)
    for sensor in sensors:
        if sensor.name in BUILT_IN and sensor.name not in wanted:
            raise ConfigError(
                f"sensor {sensor.name!r}: a batch has only its own: name it {sensor.name!r} in "
                "sensors"
            )

        # Polls come between ticks, which a batch runs in compiled code.
        if sensor.name not in BUILT_IN and (is_polled(sensor) or sensor.needs):
            raise ConfigError(
                f"sensor {sensor.name!r}: has poll or needs, which a batch doesn't have: measure "
                "in read, or make_vec with vectorization_mode='async'"
            )
    return sensors


class BatchSensors:
    """The sensors of users, each of which reads all robots of a batch.

    Attributes:
        info: An array for each key of theirs.

    Args:
        sensors: The sensors.
        tables: Arrays of the batch. The last columns of its observations are these sensors'.
        worlds: Worlds of the batch.
        dt: Duration of a firmware loop [s].
    """

    def __init__(
        self, sensors: Sequence[Sensor], tables: layout.Tables, worlds: Sequence[World], dt: float
    ) -> None:
        robots, columns = tables.observations.shape
        self._first = columns - sum(sensor.size for sensor in sensors)
        self.info: dict[str, Floats] = {}
        self._sources: dict[str, Sensor] = {}
        self._readers = [SensorReader(sensor, tables) for sensor in sensors]
        self._tables = tables
        self._worlds = worlds
        self._dt = dt
        self._scenes = [Scene()] * robots
        self._generators: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._readers)

    def forget(self, robot: int) -> None:
        """Drop the NumPy generator of a robot that has a new seed."""
        self._generators.pop(robot, None)

    def reset(self, robots: Places) -> None:
        """Reset the sensors of robots that start an episode, and read them."""
        names = ("start_x", "start_y", "start_theta", "goal_x", "goal_y", "world")
        rows = layout.read_fields(self._tables.blocks, names, robots).T.tolist()

        # Scenes are Python objects: only those of new episodes are made.
        for robot, (x, y, theta, ahead, aside, number) in zip(robots, rows, strict=True):
            start = (x, y, theta)
            world = self._worlds[int(number)] if self._worlds else None
            self._scenes[robot] = Scene(start, point_in_world(start, (ahead, aside)), world)
        self._read(robots, begins=True)

    def read(self, robots: Places) -> None:
        """Read the sensors of robots that have driven."""
        self._read(robots, begins=False)

    def _read(self, robots: Places, *, begins: bool) -> None:
        """Write what the sensors read into the observations, and their info."""
        if len(robots) == 0:
            return

        # NumPy's generators go on from the states that compiled loops use.
        rngs = LentGenerators(self._tables.random, robots.tolist(), self._generators)
        view = self._describe(robots, rngs)
        try:
            for reader in self._readers if begins else ():
                reader.reset(view, robots)
            numbers = [reader.read(view, robots) for reader in self._readers]
            self._tables.observations[robots, self._first :] = np.hstack(numbers)
            self._sources = {}
            for reader in self._readers:
                with naming_sensor(reader.sensor):
                    self._store_info(reader.sensor, reader.info(view, robots), robots)
        finally:
            rngs.give_back()

    def _store_info(self, sensor: Sensor, info: Mapping[str, Any], robots: Places) -> None:
        """Store a sensor's info in new arrays, because users may have kept the last ones."""
        for key, values in info.items():
            check_new_key(self._sources, sensor, key)
            self._sources[key] = sensor
            array = self.info.get(key, np.zeros(len(self._scenes))).copy()
            array[robots] = values
            self.info[key] = array

    def add_info(self, info: dict[str, Floats]) -> None:
        """Add the sensors' info to the batch's. ConfigError if it has one of the keys already."""
        for key, sensor in self._sources.items():
            check_new_key(info, sensor, key)
        info |= self.info

    def _describe(self, robots: Places, rngs: LentGenerators) -> SensorInput:
        """What sensors may know of these robots."""
        rows = layout.read_fields(self._tables.blocks, SENSED_FIELDS, robots)
        field = SimpleNamespace(**dict(zip(SENSED_FIELDS, rows, strict=True)))

        # Sensors see the frame of the world, the batch has the odometry frame.
        x = field.start_x + field.start_cos * field.true_x - field.start_sin * field.true_y
        y = field.start_y + field.start_sin * field.true_x + field.start_cos * field.true_y
        theta = field.start_theta + field.theta
        # Wrapped as in the single env, so that sensors get the same heading.
        theta -= layout.TURN * np.rint(theta / layout.TURN)
        forward = field.vx * np.cos(field.theta) + field.vy * np.sin(field.theta)

        # In most steps all robots drive, and no list is made.
        are_all = len(robots) == len(self._scenes)
        return SensorInput(
            pose=np.column_stack([x, y, theta]),
            twist=np.column_stack([forward, field.rate]),
            contact=field.true_contact > 0.0,
            now=field.loops * self._dt,
            scenes=self._scenes if are_all else [self._scenes[robot] for robot in robots],
            rngs=rngs,
            memory=None,
        )


class SensorReader:
    """Calls the methods of a sensor, compiled or not, with the memory of the robots."""

    def __init__(self, sensor: Sensor, tables: layout.Tables) -> None:
        self.sensor = sensor
        self._random = tables.random
        self._memory = new_memory(sensor, len(tables.random))
        self._first = new_memory(sensor, 1)
        self._is_compiled = is_compiled(sensor, SENSOR_METHODS)
        self._methods: dict[str, Any] = {"reset": sensor.reset, "read": sensor.read}
        if self._is_compiled:
            with naming_sensor(sensor):
                numbers = numbers_of(sensor)
            for name in SENSOR_METHODS:
                method = bind_methods(type(sensor), call_method, {"sensor_method": name})
                self._methods[name] = partial(method, numbers)

    def reset(self, robots: SensorInput, places: Places) -> None:
        """Start episodes: the memory gets its first values, then those of the sensor's `reset`."""
        self._memory[:, places] = self._first
        self._call("reset", robots, places)

    def read(self, robots: SensorInput, places: Places) -> Floats:
        """Read robots, (n, size)."""
        # A number that a sensor doesn't write stays NaN, which the check refuses.
        out = np.full((len(places), self.sensor.size), np.nan)
        self._call("read", robots, places, out)
        check_finite(self.sensor, out, places.tolist())
        return out

    def info(self, robots: SensorInput, places: Places) -> Mapping[str, Any]:
        """The sensor's info, each (n,)."""
        memory = name_memory(self.sensor, self._memory[:, places])
        return self.sensor.info(robots._replace(memory=memory))

    def _call(self, name: str, robots: SensorInput, places: Places, *out: Floats) -> None:
        """Call a method, and keep what it does to the memory and the generators."""
        # Indexing copies: what the method changes is written back at the end.
        rows = self._memory[:, places]
        robots = robots._replace(memory=name_memory(self.sensor, rows))
        method = self._methods[name]

        if self._is_compiled:
            # Compiled code draws from rows of states, and sees no Python objects.
            robots.rngs.give_back()
            random = self._random[places]
            try:
                method(robots._replace(scenes=None, rngs=random), *out)
            except Exception as error:
                raise name_error(f"sensor {self.sensor.name!r}", error) from error
            self._random[places] = random
        else:
            with naming_sensor(self.sensor):
                method(robots, *out)
        self._memory[:, places] = rows


sensor_method: Any = None
"""Placeholder: in the copies of `call_method` that `bind_methods` makes, a compiled method."""


def call_method(sensor: Any, *arguments: Any) -> None:
    """Call a method of a sensor."""
    sensor_method(sensor, *arguments)
