"""Movers in the engines: where they are, how they push the robot, and what the pictures show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pybullet
import pytest
from numpy.typing import NDArray

from acsar_gym import RobotConfig
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.mujoco import MujocoBody
from acsar_gym.protocol import encode
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk

Floats = NDArray[np.float64]
ACSAR = RobotConfig.preset("acsar")
NAMES = ["bullet", "mujoco"]
ENGINES = pytest.mark.parametrize("name", NAMES)
START = -0.25 - ACSAR.body.length / 2.0
"""x of a mover that touches a robot at the origin from behind [m]."""


def scene_of(*movers: Mover, **obstacles: Any) -> Scene:
    return Scene(world=World(movers=movers, **obstacles), key=0.37)


def link_in(name: str, scene: Scene, config: RobotConfig = ACSAR) -> SimulatedLink:
    """A robot at rest at the origin among movers."""
    link = SimulatedLink(config, lambda: make_body(name, config))
    link.reset(scene)
    return link


def watch(link: SimulatedLink, ticks: int, period: float = ACSAR.period) -> tuple[Floats, Floats]:
    """Poses of the robot and states of the movers after each tick."""
    poses = []
    states = []
    for _ in range(ticks):
        link.advance(period)
        crowd: Any = link.truth.crowd
        poses.append(link.truth.pose)
        states.append(crowd.states.copy())
    return np.array(poses), np.array(states)


def places_in(body: Any) -> Floats:
    """Where an engine has the movers, (movers, 2), or NaN for those that wait below the floor."""
    if isinstance(body, MujocoBody):
        assert body._world is not None
        return np.reshape(body._data.qpos[-2 * len(body._world.movers) :], (-1, 2)).copy()
    poses = [
        pybullet.getBasePositionAndOrientation(number, body._engine.number)[0]
        for number in body._movers._bodies
    ]
    return np.array([(x, y) if z > 0.0 else (np.nan, np.nan) for x, y, z in poses])


def towards_robot(speed: float, y: float = 0.0) -> Mover:
    """A mover that touches a robot at the origin after 0.1 s, and walks on."""
    return walk([[START - 0.1 * speed, y], [40.0, y]], speed, repeat=Repeat.STOP)


CROWD = scene_of(
    walk([[2.0, 1.0], [2.0, -1.0], [1.0, 0.0]], 1.5, pauses=0.2, spread=4.0),
    follow_keys([0.0, 1.0, 2.5, 3.0], [[-2, 0], [-1, 1], [0, 2], [-2, 0]], smooth=True, phase=0.3),
    follow_keys([0.0, 1.0], [[1.5, -2.0], [3.0, -2.0]], radius=0.4),  # which jumps back
    walk([[30.0, 0.0], [31.0, 0.0]], 1.0),
    walk([[-1.0, -1.0], [1.0, -1.2]], 1.0, reacts=True, sees_robot=False),
)


def test_movers_are_at_the_same_places_in_planar_pybullet_and_mujoco() -> None:
    links = [link_in(name, CROWD) for name in ("planar", *NAMES)]
    for _ in range(300):
        planar, *engines = (watch(link, 1)[1][0] for link in links)
        for states, link in zip(engines, links[1:], strict=True):
            assert states == pytest.approx(planar, abs=1e-9)
            places = places_in(link.body)
            placed = np.isfinite(places[:, 0])
            assert places[placed] == pytest.approx(states[placed, :2], abs=1e-9)
    for link in links:
        link.close()


@ENGINES
@pytest.mark.parametrize(("speed", "rate"), [(0.3, 100.0), (5.0, 10.0)])
def test_movers_push_a_robot_at_rest_at_their_speed(name: str, speed: float, rate: float) -> None:
    config = ACSAR.with_(control_rate=rate)
    link = link_in(name, scene_of(towards_robot(speed)), config)
    poses, states = watch(link, round(0.7 * rate), config.period)
    later = slice(round(0.4 * rate), None)
    speeds = np.diff(poses[:, 0]) * rate
    assert speeds[later].mean() == pytest.approx(speed, rel=0.02)
    assert speeds.max() < 1.1 * speed + 0.05
    gap = poses[:, 0] - states[:, 0, 0] + START
    assert gap[later].min() > -0.01 * max(speed, 1.0)  # it overlaps by millimetres
    link.close()


@ENGINES
def test_movers_squeeze_a_robot_against_a_wall_the_same_way_each_time(name: str) -> None:
    scene = scene_of(towards_robot(1.5, 0.1), segments=np.array([[0.45, -1.0, 0.45, 1.0]]))
    link = link_in(name, scene)
    poses, states = watch(link, 150)
    assert 0.1 < np.hypot(*poses[:, :2].T).max() < 1.5
    assert states[-1, 0, 0] == pytest.approx(START - 0.15 + 1.5 * 1.5)  # nothing stops it
    link.reset(scene)
    assert watch(link, 150)[0].tobytes() == poses.tobytes()
    link.close()


@ENGINES
def test_movers_leave_nothing_where_they_were(name: str) -> None:
    """The robot drives through the places of a mover in this episode and in the last."""
    scene = scene_of(walk([[1.0, 0.0], [1.0, 8.0]], 4.0, repeat=Repeat.STOP))
    link = link_in(name, scene)
    for _ in range(2):
        for _ in range(400):
            link.write(encode((10.0, 10.0, 10.0, 10.0)))
            link.advance(ACSAR.period)
        assert link.truth.pose[0] > 1.5
        assert not link.truth.contact
        link.reset(scene)
    link.close()
