"""The list of a robot's sensors: who may be on it, in which order, and who closes them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest
from range_finder import ThreeRays

from acsar_gym import Robot, RobotConfig, Sensor, open_link
from acsar_gym.errors import AcsarError, ConfigError

ACSAR = RobotConfig.preset("acsar")


def robot(*sensors: Any) -> Robot:
    return Robot(open_link("planar", ACSAR), ACSAR, sensors)


def special(**changes: Any) -> type[Sensor]:
    return type("Special", (ThreeRays,), changes)


def test_sensors_start_with_the_lidar_and_others_follow_in_order() -> None:
    assert robot().read().shape == (0,)
    with robot("range_finder:ThreeRays", "lidar") as driven:
        assert [sensor.name for sensor in driven.sensors] == ["lidar", "three_rays"]
        assert driven.read().shape == (64 + 3,)
        assert (driven.read()[:64] == 1.0).all()
    link = open_link("planar", ACSAR)
    ready = ThreeRays(link, ACSAR)
    made = Robot(link, ACSAR, [ready, functools.partial(special(name="other"))])
    assert made.sensors[0] is ready
    assert [sensor.name for sensor in made.sensors] == ["three_rays", "other"]


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ((ThreeRays, ThreeRays), "two are named 'three_rays'"),
        (("lidr",), "'lidar'"),
        ((special(name=""),), "must be a subclass of Sensor .* not ''"),
        ((special(read=Sensor.read),), "'three_rays': needs a method read"),
        ((special(size=0),), "'three_rays': must have a size from 1"),
        ((special(name="lidar"),), "'lidar': that name is taken"),
        ((special(memory={"my bias": 0.0}),), "'three_rays': memory = .* must be like"),
        ((special(memory={"bias": "none"}),), "'three_rays': memory = .* must be like"),
    ],
)
def test_sensors_that_cannot_be_made_are_named(sensors: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        robot(*sensors)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("method", ["reset", "poll", "read", "info"])
def test_sensor_error_stops_the_robot(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError(method)

    kind = special(poll=lambda *_: None)
    driven = robot(kind)
    if method != "reset":
        driven.activate()
    monkeypatch.setattr(kind, method, fail)
    use: dict[str, Callable[[], object]] = {
        "reset": driven.activate,
        "poll": lambda: driven.drive(0.1, 0.0),
        "read": driven.read,
        "info": lambda: driven.add_sensor_info({}),
    }
    with pytest.raises(AcsarError, match=rf"'three_rays': fail\(\) raised RuntimeError: {method}"):
        use[method]()
    assert not driven.active


def test_info_is_of_the_newest_tick() -> None:
    with pytest.raises(AcsarError, match="the LiDAR has no scan yet"):
        robot("lidar").add_sensor_info({})
    with robot(ThreeRays, "lidar") as driven:
        driven.read()
        for _ in range(3):
            driven.tick((1.0,) * 4)
        info: dict[str, float] = {}
        driven.add_sensor_info(info)
        now = driven.link.now()
        assert info["three_rays_time"] == now
        lidar: Any = driven.sensors[0]
        assert info["scan_age"] == now - lidar.scan.stamp


class Bumper(Sensor):
    name = "bumper"
    size = 1

    def read(self, robots: Any, out: Any) -> None:
        out[:, 0] = robots.contact


@pytest.mark.parametrize("kind", [ThreeRays, Bumper])
def test_sensor_of_a_simulation_fails_without_truth(
    kind: type[Sensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = robot(kind)
    monkeypatch.setattr(type(driven.link), "truth", None)
    with pytest.raises(AcsarError, match=r"nan.* A real robot's pose, twist and contact are NaN"):
        driven.read()
