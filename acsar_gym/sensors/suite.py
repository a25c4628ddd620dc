"""The sensors of one robot: named, made, reset, polled, read, checked and closed together."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError, show_value, suggest_name, translate_errors
from acsar_gym.lidar.contract import Lidar
from acsar_gym.lidar.replayed import ReplayedLidar
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.reading import import_object
from acsar_gym.sensors.lidar import LidarSensor, find_lidar
from acsar_gym.sensors.map.movers import MoversSensor
from acsar_gym.sensors.map.sensor import MapSensor, find_map
from acsar_gym.sensors.sensor import LIDAR, MAP, MOVERS, Factory, Floats, Sensor
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene


class Sensors(Sequence[Sensor]):
    """The sensors of a robot in the order of their numbers in the observation.

    Map, movers and LiDAR come first.

    Args:
        wanted: factories, or ready sensors.
        link: of the robot.
        config: of the robot.
        odometry: of the robot.

    Raises:
        ConfigError: for something that isn't a sensor, or a name, size or bounds that can't be
            used.
    """

    def __init__(
        self,
        wanted: Iterable[Sensor | Factory],
        link: Link,
        config: RobotConfig,
        odometry: Odometry,
    ) -> None:
        sensors = [make_sensor(factory, link, config) for factory in wanted]
        for sensor in sensors:
            sensor.follow(odometry)
        self._link = link
        first = {MAP: 0, MOVERS: 1, LIDAR: 2}
        self._sensors = sorted(sensors, key=lambda sensor: first.get(sensor.name, 3))
        self._polled = [one for one in self._sensors if type(one).poll is not Sensor.poll]
        self._uses_truth = any(sensor.uses_truth for sensor in self._sensors)
        check_names([sensor.name for sensor in self._sensors])
        for sensor in self._sensors:
            if isinstance(sensor, MapSensor):
                sensor.watch(find_lidar(self._sensors))
            elif isinstance(sensor, MoversSensor):
                sensor.watch(find_map(self._sensors))

    def __getitem__(self, index: Any) -> Any:
        return self._sensors[index]

    def __len__(self) -> int:
        return len(self._sensors)

    def __iter__(self) -> Iterator[Sensor]:
        return iter(self._sensors)

    @property
    def clocked(self) -> bool:
        """Whether any of them has a clock of its own, and must be polled after every tick."""
        return bool(self._polled)

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode: reset each sensor; those with a clock of their own measure.

        Args:
            scene: the world, and the robot's start in it.
            rng: the env's generator.
        """
        for sensor in self._sensors:
            with naming_sensor(sensor):
                sensor.reset(scene, rng)
                if sensor in self._polled:
                    sensor.poll(self._truth(), self._link.now())

    def poll(self) -> None:
        """Poll sensors with a clock of their own, after a tick."""
        truth, now = self._truth(), self._link.now()
        for sensor in self._polled:
            with naming_sensor(sensor):
                sensor.poll(truth, now)

    def read(self) -> Floats:
        """Read all of them.

        Returns:
            Their numbers, of shape (sum of sizes,).

        Raises:
            AcsarError: for anything else than `size` finite numbers, and where a sensor raises
                an error; names the sensor.
        """
        if not self._sensors:
            return np.zeros(0)
        truth, now = self._truth(), self._link.now()
        parts = []
        for sensor in self._sensors:
            with naming_sensor(sensor):
                parts.append(check_numbers(sensor, sensor.read(truth, now)))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _truth(self) -> GroundTruth | None:
        """The link's ground truth, if any sensor uses it."""
        return self._link.truth if self._uses_truth else None

    def info(self, info: dict[str, float]) -> None:
        """Add what the sensors tell to an env's info.

        Args:
            info: gets their keys and values.

        Raises:
            ConfigError: it has one of the keys already.
        """
        now = self._link.now()
        for sensor in self._sensors:
            with naming_sensor(sensor):
                add_sensor_info(info, sensor, now)

    def close(self) -> None:
        """Close all of them, even where one raises; idempotent."""

        def close(sensor: Sensor) -> None:
            with naming_sensor(sensor):
                sensor.close()

        with contextlib.ExitStack() as stack:
            for sensor in reversed(self._sensors):
                stack.callback(close, sensor)


def naming_sensor(sensor: Sensor) -> contextlib.AbstractContextManager[None]:
    """Turn errors that the sensor raises inside a block into an AcsarError with its name."""
    return translate_errors(AcsarError, lambda: f"sensor {sensor.name!r}")


def make_sensor(factory: Any, link: Link, config: RobotConfig) -> Sensor:
    """Make a sensor with its factory; a ready sensor is returned.

    Raises:
        ConfigError: it isn't a sensor, or its name, size or bounds can't be used.
        AcsarError: the factory raises an error.
    """
    if not callable(factory) and not isinstance(factory, Sensor):
        raise ConfigError(
            f"sensors: {show_value(factory)} must be a subclass of Sensor or a factory"
        )
    with translate_errors(AcsarError, lambda: f"sensors: {show_value(factory)}"):
        sensor = factory if isinstance(factory, Sensor) else factory(link, config)
    if not isinstance(sensor, Sensor):
        raise ConfigError(
            f"sensors: {show_value(sensor)}, made by {show_value(factory)}, is no Sensor"
        )
    name, size = getattr(sensor, "name", None), getattr(sensor, "size", None)
    if not isinstance(name, str) or not name.isidentifier():
        raise ConfigError(
            f"{type(sensor).__name__}.name = {show_value(name)}: must be a word of letters, "
            "digits and _"
        )
    if not isinstance(size, int | np.integer) or isinstance(size, bool) or size < 1:
        raise ConfigError(
            f"sensor {name!r}: size = {show_value(size)} must be a whole number from 1"
        )
    _check_batch_methods(sensor)
    try:
        low, high = sensor.bounds
        sound = bool((low <= high).all())
    except (TypeError, ValueError):
        sound = False
    if not sound:
        raise ConfigError(
            f"sensor {name!r}: low = {show_value(sensor.low)}, high = {show_value(sensor.high)} "
            f"must be numbers or ({size},) arrays, low <= high"
        )
    return sensor


def _check_batch_methods(sensor: Sensor) -> None:
    """Raise ConfigError where methods are missing, or what `read_batch` remembers is no memory."""
    named, memory = f"sensor {sensor.name!r}", sensor.memory
    if not hasattr(sensor, "read_batch"):
        if type(sensor).read is Sensor.read:
            raise ConfigError(f"{named}: needs a method read, or read_batch")
        if hasattr(sensor, "reset_batch") or sensor.compiled:
            raise ConfigError(f"{named}: reset_batch and compiled are for sensors with read_batch")
        return
    if (
        not isinstance(memory, Mapping)
        or not all(isinstance(name, str) and name.isidentifier() for name in memory)
        or not all(isinstance(value, bool | int | float) for value in memory.values())
    ):
        raise ConfigError(f"{named}: memory = {show_value(memory)}: must be like {{'bias': 0.0}}")
    if hasattr(sensor, "reset_batch") and not memory:
        raise ConfigError(
            f"{named}: has reset_batch, but remembers nothing: say what, such as "
            "memory = {'bias': 0.0}"
        )


def check_names(names: Sequence[str]) -> None:
    """Raise ConfigError where two sensors have the same name."""
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"sensors: two are named {name!r}: give each a name of its own")


def check_numbers(sensor: Sensor, numbers: Any) -> Floats:
    """Convert what a sensor has read to float64.

    Raises:
        AcsarError: for anything else than finite numbers of shape (size,).
    """
    try:
        array = np.asarray(numbers)
    except ValueError:  # lists of lists of unequal lengths
        array = np.zeros((), object)
    if array.shape != (sensor.size,) or array.dtype.kind not in "fiub":
        raise AcsarError(
            f"sensor {sensor.name!r}: read() gave {array.dtype} of shape {array.shape}: must be "
            f"numbers of shape ({sensor.size},)"
        )
    if not np.isfinite(array).all():
        raise AcsarError(
            f"sensor {sensor.name!r}: read() gave {show_value(array.tolist())}: must be finite "
            "numbers"
        )
    return array.astype(np.float64, copy=False)


def add_sensor_info(info: dict[str, float], sensor: Sensor, now: float) -> None:
    """Add a sensor's info to the env's. ConfigError for a key that is there already."""
    for key, value in sensor.info(now).items():
        check_info_key(info, sensor, key)
        info[key] = float(value)


def check_info_key(info: Mapping[str, Any], sensor: Sensor, key: str) -> None:
    """Raise ConfigError where info has the key already."""
    if key in info:
        raise ConfigError(
            f"sensor {sensor.name!r}: info tells {key!r}, which is there already: "
            f"name it {sensor.name}_{key}"
        )


def open_lidar(url: Any, link: Link, config: RobotConfig) -> Lidar:
    """Make the LiDAR that a user names; nothing is opened before its `reset`.

    Raises:
        ConfigError: for anything else, for a simulated LiDAR on a link without a simulation, and
            for a device on a link that doesn't run in real time.
    """
    if url is None and link.ros is not None:
        url = link.ros.device
    if isinstance(url, str) and (url == "ros2" or url.startswith("ros2:")):
        return _open_topic(url, link, config)
    if url is None or (isinstance(url, str) and url == "simulated"):
        if link.scans is not None:
            return ReplayedLidar(link.scans, link)
        if link.truth is None:
            raise ConfigError(
                "this env needs a LiDAR and this link simulates none: name its model and device as "
                "lidar (--lidar), like rplidar:///dev/ttyUSB1"
            )
        return SimulatedLidar(link, config)
    if isinstance(url, str) and "://" in url:
        return _open_device(url, link, config)
    made = url
    if isinstance(url, str) and ":" in url and "/" not in url:
        made = import_object("lidar", url)
    if isinstance(made, type) or made is not url:
        with translate_errors(AcsarError, lambda: f"lidar = {show_value(url)}"):
            made = made(link, config)
    if not all(callable(getattr(made, name, None)) for name in ("reset", "scan", "close")):
        raise ConfigError(
            f"lidar = {show_value(url)}: must be like 'rplidar:///dev/ttyUSB1', 'ros2', "
            "'module:Class', or 'simulated'"
        )
    ready: Lidar = made
    return ready


def _check_real_time(url: str, link: Link) -> None:
    """Raise ConfigError for a LiDAR that measures in real time on a link that doesn't."""
    if link.truth is not None or link.scans is not None:
        raise ConfigError(
            f"lidar = {show_value(url)}: a device measures in real time, and this link is a "
            "simulation or a recording: leave it out there"
        )


def _open_topic(url: str, link: Link, config: RobotConfig) -> Lidar:
    from acsar_gym.lidar.ros2 import RosLidar  # noqa: PLC0415

    _check_real_time(url, link)
    return RosLidar(url, link, config)


def _open_device(url: str, link: Link, config: RobotConfig) -> Lidar:
    from acsar_gym.lidar.drivers import find_drivers  # noqa: PLC0415 - imports pyserial
    from acsar_gym.lidar.serial import SerialLidar  # noqa: PLC0415

    model, _, device = url.partition("://")
    drivers = find_drivers()
    make_driver = drivers.get(model.lower().replace("-", "_"))
    if make_driver is None:
        raise ConfigError(f"lidar = {show_value(url)}: unknown model; known: {', '.join(drivers)}")
    if not device:
        raise ConfigError(
            f"lidar = {show_value(url)}: names no device: must be like '{model}:///dev/ttyUSB1'"
        )
    _check_real_time(url, link)
    return SerialLidar(device, make_driver, config, link.clock)


def sensor_factories(
    sensors: Iterable[str | Sensor | Factory], lidar: Any = None, period: float = 0.1
) -> list[Sensor | Factory]:
    """Replace names among the sensors of a task or an env by factories.

    Raises:
        ConfigError: A name is unknown.
    """

    def make_lidar(link: Link, config: RobotConfig) -> Sensor:
        return LidarSensor(open_lidar(lidar, link, config), config)

    factories: list[Sensor | Factory] = []
    for sensor in sensors:
        if not isinstance(sensor, str):
            factories.append(sensor)
        elif ":" in sensor:
            factories.append(import_object("sensor", sensor))
        elif sensor == LIDAR:
            factories.append(make_lidar)
        elif sensor == MAP:
            factories.append(partial(MapSensor, period=period))
        elif sensor == MOVERS:
            factories.append(MoversSensor)
        else:
            near = suggest_name(sensor, [LIDAR, MAP, MOVERS])
            raise ConfigError(f"unknown sensor {show_value(sensor)}{near}")
    return factories
