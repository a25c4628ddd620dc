"""The sensors of one robot: made, connected, reset, polled, read, checked and closed together."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError, TranslatedErrors, show_value, suggest_name
from acsar_gym.lidar.factory import open_lidar
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.reading import import_object
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.sensors.map.movers import MoversSensor
from acsar_gym.sensors.map.sensor import MapSensor
from acsar_gym.sensors.sensor import (
    LIDAR,
    MAP,
    MOVERS,
    Factory,
    Floats,
    Sensor,
    SensorInput,
    name_memory,
    new_memory,
)
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene

BUILT_IN: dict[str, type[Sensor]] = {MAP: MapSensor, MOVERS: MoversSensor, LIDAR: LidarSensor}
"""Sensors that are chosen by their names, in the order of their numbers in the observation. Those
of users follow."""
UNKNOWN = GroundTruth(
    pose=(math.nan,) * 3,
    twist=(math.nan,) * 2,
    contact=math.nan,  # type: ignore[arg-type]
)
"""The truth on hardware. A contact that is False would be taken for known."""


class Sensors(Sequence[Sensor]):
    """The sensors of a robot in the order of their numbers in the observation.

    Args:
        wanted: Factories, or ready sensors.
        link: Link of the robot.
        config: Robot configuration.
        odometry: Odometry of the robot.

    Raises:
        ConfigError: Something isn't a sensor, or has a name, size or bounds that can't be used.
    """

    def __init__(
        self,
        wanted: Iterable[Sensor | Factory],
        link: Link,
        config: RobotConfig,
        odometry: Odometry,
    ) -> None:
        self._link = link
        self._sensors = make_sensors(wanted, link, config)

        # A sensor may use any other, in whatever order they were given.
        by_name = {sensor.name: sensor for sensor in self._sensors}
        for sensor in self._sensors:
            sensor.connect(odometry, {name: by_name[name] for name in sensor.needs})
        self._polled = [sensor for sensor in self._sensors if is_polled(sensor)]

        # Of the episode.
        self._scene = Scene()
        self._rng = np.random.default_rng(0)
        self._memories = [new_memory(sensor, 1) for sensor in self._sensors]
        self._newest: SensorInput | None = None

    def __getitem__(self, index: Any) -> Any:
        return self._sensors[index]

    def __len__(self) -> int:
        return len(self._sensors)

    @property
    def clocked(self) -> bool:
        """Whether any of them has a clock of its own, and must be polled after every tick."""
        return bool(self._polled)

    def _look(self) -> SensorInput:
        """What sensors may know of the robot now."""
        truth = self._link.truth or UNKNOWN
        return SensorInput(
            pose=np.array([truth.pose]),
            twist=np.array([truth.twist]),
            contact=np.array([truth.contact]),
            now=np.array([self._link.now()]),
            scenes=[self._scene],
            rngs=[self._rng],
            memory=None,
        )

    def _inputs(self, newest: SensorInput) -> Iterator[tuple[Sensor, SensorInput]]:
        """Each sensor, and what it may know, with its memory."""
        for sensor, memory in zip(self._sensors, self._memories, strict=True):
            robot = newest
            if sensor.memory:
                robot = robot._replace(memory=name_memory(sensor, memory))
            yield sensor, robot

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Start an episode: reset each sensor. Those with a clock of their own measure.

        Args:
            scene: The world, and the robot's start in it.
            rng: The env's generator.
        """
        self._scene = scene
        self._rng = rng
        self._memories = [new_memory(sensor, 1) for sensor in self._sensors]
        self._newest = self._look()
        for sensor, robot in self._inputs(self._newest):
            with naming_sensor(sensor):
                sensor.reset(robot)

                # The first observation is of now.
                if sensor in self._polled:
                    sensor.poll(self._link.truth, self._link.now())

    def poll(self) -> None:
        """Poll sensors with a clock of their own, after a tick."""
        truth = self._link.truth
        now = self._link.now()
        for sensor in self._polled:
            # In every tick: a `with` around the call would cost as much as the call.
            try:
                sensor.poll(truth, now)
            except Exception:
                with naming_sensor(sensor):
                    raise

    def read(self) -> Floats:
        """Read all of them.

        Returns:
            Their numbers, of shape (sum of sizes,).

        Raises:
            AcsarError: A sensor raises an error, or doesn't give finite numbers.
        """
        if not self._sensors:
            return np.zeros(0)
        self._newest = self._look()
        readings = []
        # NaN shows which numbers a sensor didn't fill in.
        for sensor, robot in self._inputs(self._newest):
            reading = np.full((1, sensor.size), np.nan)
            with naming_sensor(sensor):
                sensor.read(robot, reading)
            readings.append(reading)

        # A test of all numbers at once is faster than tests of each sensor's numbers.
        numbers: Floats = np.concatenate(readings, axis=1)[0]
        if not np.isfinite(numbers).all():
            for sensor, reading in zip(self._sensors, readings, strict=True):
                check_finite(sensor, reading)
        return numbers

    def info(self, info: dict[str, float]) -> None:
        """Add what the sensors report now to an env's info.

        Args:
            info: Gets their keys and values.

        Raises:
            ConfigError: It has one of the keys already.
        """
        # The robot may have driven since its sensors were read. A look takes 10 us.
        if self._newest is None or self._newest.now[0] != self._link.now():
            self._newest = self._look()
        for sensor, robot in self._inputs(self._newest):
            with naming_sensor(sensor):
                for key, values in sensor.info(robot).items():
                    check_new_key(info, sensor, key)
                    info[key] = float(values[0])

    def close(self) -> None:
        """Close all of them, even if one raises. Idempotent."""

        def close(sensor: Sensor) -> None:
            with naming_sensor(sensor):
                sensor.close()

        # All devices are closed, whatever any of them raises.
        with contextlib.ExitStack() as stack:
            for sensor in reversed(self._sensors):
                stack.callback(close, sensor)


def naming_sensor(sensor: Sensor) -> contextlib.AbstractContextManager[None]:
    """Turn errors that the sensor raises inside a block into an AcsarError with its name."""
    return TranslatedErrors(AcsarError, lambda: f"sensor {sensor.name!r}")


def check_new_key(info: Mapping[str, Any], sensor: Sensor, key: str) -> None:
    """Raise ConfigError if info has a sensor's key already."""
    if key in info:
        raise ConfigError(
            f"sensor {sensor.name!r}: info has {key!r} already: name it {sensor.name}_{key}"
        )


def is_polled(sensor: Sensor) -> bool:
    """Whether a sensor has a clock of its own."""
    return type(sensor).poll is not Sensor.poll


def make_sensors(
    wanted: Iterable[Sensor | Factory], link: Link, config: RobotConfig
) -> list[Sensor]:
    """Make a robot's sensors, in the order of their numbers in the observation.

    Raises:
        ConfigError: Something isn't a sensor, has a name that is taken, or lacks what it needs.
    """
    order = [*BUILT_IN]
    sensors = [make_sensor(factory, link, config) for factory in wanted]

    # Built-in sensors have fixed places, all others keep their order behind them.
    sensors.sort(key=lambda sensor: (*order, sensor.name).index(sensor.name))
    names = [sensor.name for sensor in sensors]
    for sensor in sensors:
        if names.count(sensor.name) > 1:
            raise ConfigError(f"sensors: two are named {sensor.name!r}: rename one of them")
        for name in sensor.needs:
            if name not in names:
                raise ConfigError(
                    f"sensor {sensor.name!r}: the robot has no {name!r}, which it needs"
                )
    return sensors


def make_sensor(factory: Any, link: Link, config: RobotConfig) -> Sensor:
    """Make a sensor with its factory. A ready sensor is returned.

    Raises:
        ConfigError: It isn't a sensor, or its name, size or bounds can't be used.
        AcsarError: The factory raises an error.
    """
    # A factory may be any callable of the user.
    with TranslatedErrors(AcsarError, lambda: f"sensors: {show_value(factory)}"):
        sensor = factory(link, config) if callable(factory) else factory
    name = getattr(sensor, "name", None)
    if not isinstance(sensor, Sensor) or not isinstance(name, str) or not name.isidentifier():
        raise ConfigError(
            f"sensors: {show_value(factory)} must be a subclass of Sensor or a factory, whose name "
            f"is a word of letters, digits and _, not {show_value(name)}"
        )
    if type(sensor).read is Sensor.read:
        raise ConfigError(f"sensor {name!r}: needs a method read(robots, out)")
    # Other code finds built-in sensors by their names.
    if not isinstance(sensor, BUILT_IN.get(name, Sensor)):
        raise ConfigError(f"sensor {name!r}: that name is taken: rename yours")

    with TranslatedErrors(ConfigError, lambda: f"sensor {name!r}"):
        low, high = sensor.bounds
        if sensor.size < 1 or not (low <= high).all():
            raise ConfigError(
                f"sensor {name!r}: must have a size from 1, and low <= high, numbers or (size,)"
            )

    memory = sensor.memory
    if not isinstance(memory, Mapping) or not all(
        str(key).isidentifier() and isinstance(value, int | float) for key, value in memory.items()
    ):
        raise ConfigError(
            f"sensor {name!r}: memory = {show_value(memory)}: must be like {{'bias': 0.0}}"
        )
    return sensor


def check_finite(sensor: Sensor, numbers: Floats, robots: Sequence[int] = ()) -> None:
    """Check what a sensor has read, (n, size). `robots` are their numbers in a batch.

    Raises:
        AcsarError: A number isn't finite.
    """
    is_finite = np.isfinite(numbers).all(axis=1)
    if is_finite.all():
        return
    row = int(is_finite.argmin())
    whose = f" for robot {robots[row]}" if len(robots) else ""
    raise AcsarError(
        f"sensor {sensor.name!r}: read() left {show_value(numbers[row].tolist())}{whose}: must "
        "fill out with finite numbers. A real robot's pose, twist and contact are NaN"
    )


def sensor_factories(
    sensors: Iterable[str | Sensor | Factory], lidar: Any = None, period: float = 0.1
) -> list[Sensor | Factory]:
    """Replace names among the sensors of a task or an env by factories.

    Raises:
        ConfigError: A name is unknown.
    """

    def make_lidar(link: Link, config: RobotConfig) -> Sensor:
        return LidarSensor(open_lidar(lidar, link, config), config)

    built_in: dict[str, Factory] = {
        MAP: partial(MapSensor, period=period),
        MOVERS: MoversSensor,
        LIDAR: make_lidar,
    }
    factories: list[Sensor | Factory] = []
    for sensor in sensors:
        if not isinstance(sensor, str):
            factories.append(sensor)
        elif ":" in sensor:
            factories.append(import_object("sensor", sensor))
        elif sensor in built_in:
            factories.append(built_in[sensor])
        else:
            raise ConfigError(
                f"unknown sensor {show_value(sensor)}{suggest_name(sensor, built_in)}"
            )
    return factories
