"""Movers in the engines: where they are, how they push the robot, and what the pictures show."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pybullet
import pytest
from numpy.typing import NDArray

from acsar_gym import RobotConfig
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.body import Body
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.physics.mujoco import MujocoBody
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import encode
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk

Floats = NDArray[np.float64]
ACSAR = RobotConfig.preset("acsar")
ENGINES = [BulletBody, MujocoBody]
WALL = np.array([[0.45, -1.0, 0.45, 1.0]])
HALF = ACSAR.body.length / 2.0
KEY = 0.37


def link_in(make: Callable[..., Body], movers: list[Mover], **options: Any) -> SimulatedLink:
    """A robot that stands at the origin among movers."""
    config = options.pop("config", ACSAR)
    link = SimulatedLink(config, lambda: make(config))
    link.reset(Scene(world=World(movers=tuple(movers), **options), key=KEY))
    return link


def watch(link: SimulatedLink, ticks: int, period: float = ACSAR.period) -> tuple[Floats, Floats]:
    """Poses of the robot and states of the movers after each tick."""
    poses, states = [], []
    for _ in range(ticks):
        link.advance(period)
        truth = link.truth
        assert truth.crowd is not None
        poses.append(truth.pose)
        states.append(truth.crowd.states.copy())
    return np.array(poses), np.array(states)


def places_in(body: Any) -> Floats:
    """Where an engine has the movers, (movers, 2); NaN for those that wait below the floor."""
    if isinstance(body, MujocoBody):
        return np.reshape(body._data.qpos[-2 * len(body._world.movers) :], (-1, 2)).copy()  # type: ignore[union-attr]
    poses = [
        pybullet.getBasePositionAndOrientation(number, body._client)[0]
        for number in body._movers._bodies
    ]
    return np.array([(x, y) if z > 0.0 else (np.nan, np.nan) for x, y, z in poses])


def towards_robot(speed: float, aside: float = 0.0) -> Mover:
    """Somebody who touches a robot at the origin after 0.1 s, and walks on."""
    return walk([[-0.25 - HALF - 0.1 * speed, aside], [40.0, aside]], speed, repeat=Repeat.STOP)


CROWD = [
    walk([[2.0, 1.0], [2.0, -1.0], [1.0, 0.0]], 1.5, pauses=0.2, spread=4.0),
    follow_keys([0.0, 1.0, 2.5, 3.0], [[-2, 0], [-1, 1], [0, 2], [-2, 0]], smooth=True, phase=0.3),
    follow_keys([0.0, 1.0], [[1.5, -2.0], [3.0, -2.0]], radius=0.4),  # which jumps back
    walk([[30.0, 0.0], [31.0, 0.0]], 1.0),
    walk([[-1.0, -1.0], [1.0, -1.2]], 1.0, reacts=True, sees_robot=False),
]


def test_planar_pybullet_and_mujoco_agree_where_movers_are() -> None:
    links = [link_in(make, CROWD) for make in (PlanarBody, *ENGINES)]
    for _ in range(300):
        link_states = [watch(link, 1)[1][0] for link in links]
        for states, link in zip(link_states[1:], links[1:], strict=True):
            assert states == pytest.approx(link_states[0], abs=1e-9)
            there = places_in(link.body)
            placed = np.isfinite(there[:, 0])
            assert there[placed] == pytest.approx(states[placed, :2], abs=1e-9)
    expected = [mover.position(3.0) for mover in CROWD[1:4]]
    assert link_states[0][1:4, :2] == pytest.approx(np.array(expected), abs=1e-9)
    for link in links:
        link.close()


def test_between_two_ticks_they_go_on() -> None:
    """A controller of 10 Hz has ticks in which a walker goes 15 cm; a firmware loop is 5 ms."""
    config = ACSAR.with_(control_rate=10.0)
    for make in ENGINES:
        link = link_in(make, [walk([[-0.3, 1.0], [9.0, 1.0]], 1.5)], config=config)
        link.advance(config.period)
        assert link.body is not None
        before = places_in(link.body)
        for loop in range(1, 20):
            link.body.step((0.0, 0.0, 0.0, 0.0))
            ahead = before + np.array([[0.0075 * loop, 0.0]])
            assert places_in(link.body) == pytest.approx(ahead, abs=1e-6)
        link.close()


@pytest.mark.parametrize("make", ENGINES)
@pytest.mark.parametrize(("speed", "rate"), [(0.3, 100.0), (1.5, 100.0), (1.5, 10.0), (5.0, 100.0)])
def test_a_standing_robot_is_pushed_at_the_movers_speed(
    make: type[Body], speed: float, rate: float
) -> None:
    config = ACSAR.with_(control_rate=rate)
    link = link_in(make, [towards_robot(speed)], config=config)
    poses, states = watch(link, round(0.7 * rate), config.period)
    later = slice(round(0.4 * rate), None)
    speeds = np.diff(poses[:, 0]) * rate
    assert speeds[later].mean() == pytest.approx(speed, rel=0.02)
    assert speeds.max() < 1.1 * speed + 0.05
    apart = poses[:, 0] - states[:, 0, 0] - HALF - 0.25
    assert apart[later].min() > -0.01 * max(speed, 1.0)  # it overlaps by millimetres
    assert states[-1, 0, 2] == speed
    link.close()


@pytest.mark.parametrize("make", ENGINES)
@pytest.mark.parametrize("aside", [0.0, 0.1])
def test_a_robot_that_is_squeezed_against_a_wall_stays_near(make: type[Body], aside: float) -> None:
    link = link_in(make, [towards_robot(1.5, aside)], segments=WALL)
    poses, states = watch(link, 150)
    assert np.hypot(*poses[:, :2].T).max() < 1.5
    assert states[-1, 0, 0] == pytest.approx(-0.25 - HALF - 0.15 + 1.5 * 1.5)  # nothing stops it
    link.close()


@pytest.mark.parametrize("make", [PlanarBody, *ENGINES])
def test_the_crowd_says_whom_the_robot_touches_not_the_engine(make: type[Body]) -> None:
    link = link_in(make, [towards_robot(1.0)])
    assert link.body is not None
    watch(link, 8)
    assert not link.truth.contact
    watch(link, 12)
    assert link.truth.contact
    assert not link.body.truth.contact
    link.close()


@pytest.mark.parametrize("make", ENGINES)
def test_nothing_is_left_where_somebody_was(make: type[Body]) -> None:
    """The robot drives through the place of one who has gone, and of one of the last episode."""
    gone = walk([[1.0, 0.0], [1.0, 8.0]], 4.0, repeat=Repeat.STOP)
    link = link_in(make, [gone])
    scene = Scene(world=World(movers=(gone,)))
    for _ in range(2):
        for _ in range(400):
            link.write(encode((10.0, 10.0, 10.0, 10.0)))
            link.advance(ACSAR.period)
        assert link.truth.pose[0] > 1.5
        assert not link.truth.contact
        link.reset(scene)
    link.close()


def test_movers_far_away_change_nothing_in_pybullet() -> None:
    def drive(movers: list[Mover]) -> list[Any]:
        link = link_in(BulletBody, movers)
        poses = []
        for _ in range(100):
            link.write(encode((8.0, 3.0, 3.0, 8.0)))
            link.advance(ACSAR.period)
            poses.append(link.truth.pose)
        link.close()
        return poses

    assert drive([walk([[9.0, 0.0], [9.0, 9.0]])] * 3) == drive([])


@pytest.mark.parametrize("make", ENGINES)
def test_an_episode_repeats_bit_for_bit(make: type[Body]) -> None:
    link = link_in(make, [towards_robot(1.5, 0.05), *CROWD])
    first, _ = watch(link, 60)
    world = link.body._world if make is MujocoBody else link.body._statics.world  # type: ignore[union-attr]
    link.reset(Scene(world=world, key=KEY))
    again, _ = watch(link, 60)
    assert again.tobytes() == first.tobytes()
    assert math.dist(first[-1, :2], (0.0, 0.0)) > 0.1
    link.close()


@pytest.mark.parametrize("make", ENGINES)
def test_pictures_show_movers_where_they_are(make: Any) -> None:
    """In their own colour; the camera looks from behind the robot."""

    def count_violet(picture: Any) -> int:
        red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
        return int(((red > 1.5 * green) & (blue > 1.1 * red)).sum())

    crossing = walk([[2.0, -1.5], [2.0, 8.0]], 4.0, repeat=Repeat.STOP)
    link = link_in(make, [crossing])
    body: Any = link.body
    counts = []
    for _ in range(3):
        picture = body.image(96, 72)
        counts.append([count_violet(picture[:, side]) for side in (slice(48), slice(48, 96))])
        watch(link, 65)
    (left, right), (left_then, right_then), last = counts
    assert left < right
    assert right > 100
    assert left_then > right_then
    assert left_then > 100
    assert sum(last) < 20
    link.close()
