"""The list of a robot's sensors: who may be on it, in which order, and who closes them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from range_finder import ThreeRays

from acsar_gym import Robot, RobotConfig, Sensor, open_link
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.sensors.lidar import LidarSensor

ACSAR = RobotConfig.preset("acsar")


def robot(*sensors: Any) -> Robot:
    return Robot(open_link("planar", ACSAR), ACSAR, sensors)


def special(**changes: Any) -> type[Sensor]:
    return type("Special", (ThreeRays,), changes)


def test_the_lidar_is_the_first_one_and_others_follow_in_order() -> None:
    assert robot().read().shape == (0,)
    one = robot("range_finder:ThreeRays", "lidar")
    assert [sensor.name for sensor in one.sensors] == ["lidar", "three_rays"]
    assert isinstance(one.sensors[0], LidarSensor)
    with one:
        assert one.read().shape == (64 + 3,)
        assert (one.read()[:64] == 1.0).all()
    link = open_link("planar", ACSAR)
    ready = ThreeRays(link, ACSAR)
    made = Robot(link, ACSAR, [ready, functools.partial(special(name="other"))])
    assert made.sensors[0] is ready
    assert [sensor.name for sensor in made.sensors] == ["three_rays", "other"]


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ((ThreeRays, ThreeRays), "two are named 'three_rays'"),
        (("nobodys:Rays",), "sensor = 'nobodys:Rays'"),
        (("lidr",), "'lidar'"),
        ((special(name=""),), "Special.name = ''"),
        ((special(size=0),), "sensor 'three_rays': size = 0"),
        ((special(low=2.0),), "low = 2.0, high = 1.0 must be"),
        ((special(compiled=True),), "compiled are for sensors with read_batch"),
        ((special(read=Sensor.read),), "'three_rays': needs a method read, or read_batch"),
        ((special(read_batch=None, memory=["bias"]),), r"memory = \['bias'\]: must be like"),
        ((special(read_batch=None, reset_batch=None),), "reset_batch, but remembers nothing"),
    ],
)
def test_what_cannot_be_on_it_is_named(sensors: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        robot(*sensors)
    assert "\n" not in str(caught.value)


class Device(ThreeRays):
    """Counts what is done with it, and fails where it is told to."""

    def __init__(self, link: Any, config: RobotConfig) -> None:
        super().__init__(link, config)
        self.calls: list[str] = []
        self.fails_in = ""

    def _do(self, what: str) -> None:
        self.calls.append(what)
        if what == self.fails_in:
            raise RuntimeError(what)

    def reset(self, scene: Any, rng: Any) -> None:
        super().reset(scene, rng)
        self._do("reset")

    def poll(self, truth: Any, now: float) -> None:
        self._do("poll")

    def read(self, truth: Any, now: float) -> Any:
        self._do("read")
        return np.zeros(3)

    def info(self, now: float) -> dict[str, float]:
        self._do("info")
        return {}

    def close(self) -> None:
        self._do("close")


@pytest.mark.parametrize("what", ["reset", "poll", "read", "info"])
def test_any_error_of_it_stops_the_robot(what: str) -> None:
    one = robot(Device)
    device: Any = one.sensors[0]
    if what != "reset":
        one.activate()
    device.fails_in = what
    use: dict[str, Callable[[], object]] = {
        "reset": one.activate,
        "poll": lambda: one.drive(0.1, 0.0),
        "read": one.read,
        "info": lambda: one.add_sensor_info({}),
    }
    with pytest.raises(AcsarError, match=rf"'.*': {what}\(\) raised RuntimeError: {what}"):
        use[what]()
    assert not one.active
