"""The simulated LiDAR against the emulated one: one drive over both ports, same poses and times."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from serial_tools import Emulated, StartEmulator

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.hashing import hash_sample
from acsar_gym.lidar.scan import Revolution, fill_scan, make_rays, ray_spec
from acsar_gym.lidar.simulated import (
    LidarTraits,
    Passers,
    add_errors,
    aim_beams,
    make_beams,
    see_passers,
)
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.sensors.suite import open_lidar
from acsar_gym.tools.emulation.board import LIDAR_SAMPLES
from acsar_gym.trigonometry import cos_sin
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import Crowd
from acsar_gym.worlds.geometry import Obstacles, cast_lines, make_surroundings, measure_ranges
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

Floats = NDArray[np.float64]

ARCS = (0.25, 0.8), (0.25, -0.8), (-0.25, 1.2), (-0.25, -1.2)
ARC_STEPS = 10
ROUNDS = 8
"""Most rounds of these arcs; a machine that is busy needs more than one."""
ENOUGH = 40
"""How many scans of the drive are judged, at least."""
LATE = 0.01
"""The emulator goes by the machine's clock. While it is later than this, its revolutions and the
robot's odometry are late, too, and say nothing about LiDARs [s]."""
ROWS = 60
SPACING = np.radians(360.0 / LIDAR_SAMPLES)
OFFS = np.linspace(-1.0, 1.0, 9)
KEY = 0.4
"""Of the movers' episode."""
NO_ERRORS = LidarTraits(10.0, 0.0, 0.0, 0.0, 0.0)
JUMP = 0.1
"""Where ranges beside each other differ by more than this, there is an edge [m]."""


class Read(NamedTuple):
    """What one step of the drive read."""

    now: float
    revolution: Revolution


class Way(NamedTuple):
    """Where the robot really was, by the emulator's log."""

    times: Floats
    """(n,): when each loop of the emulator was due, on the machine's clock [s]."""
    episode: Floats
    """(n,): the time of the movers' episode then, which began with the first command [s]."""
    late: Floats
    """(n,): how much later it was over [s]."""
    poses: Floats
    """(n, 3), the heading unwrapped."""
    ends: Floats
    """When revolutions of the LiDAR ended: a last measurement is one before straight ahead [s]."""

    def trail(self, now: float, period: float) -> Floats:
        """True poses until now, as `Trail.rows`, the newest last."""
        times = now - period * np.arange(ROWS)[::-1]
        return np.stack([times, *(np.interp(times, self.times, p) for p in self.poses.T)], axis=1)

    def was_timely(self, since: float, until: float) -> bool:
        """Whether the emulator kept up with the clock."""
        during = (self.times > since) & (self.times < until)
        return bool(during.any() and self.late[during].max() < LATE)


def follow(emulated: Emulated, config: RobotConfig) -> Way:
    """The robot's way so far."""
    period = 1.0 / config.firmware.loop_rate
    events = emulated.events()
    restarts = np.cumsum(["lost" in event for event in events])
    at = [k for k, event in enumerate(events) if "pose" in event]
    said = np.array([events[k]["t"] for k in at])
    poses = np.array([events[k]["pose"] for k in at])
    poses[:, 2] = np.unwrap(poses[:, 2])
    loops = np.arange(len(at), dtype=np.float64)
    due = said - loops * period
    for restart in set(restarts[at].tolist()):  # from each on, loops have their own even times
        own = restarts[at] == restart
        due[own] = due[own].min() + loops[own] * period
    a_turn = round(1.0 / (config.lidar.rate * period))
    ends = due[(loops + 1) % a_turn == 0] - 1.0 / (config.lidar.rate * LIDAR_SAMPLES)
    first = np.searchsorted(at, next(k for k, event in enumerate(events) if "rx" in event))
    return Way(due, (loops + 1.0 - float(first)) * period, said - due, poses, ends)


def drive_arcs(emulated: Emulated, lidar: str, config: RobotConfig) -> tuple[list[Read], Way]:
    """Drive until enough scans were read while the emulator was timely; those, and the way."""
    link = open_link(emulated.device, config)
    sensor = LidarSensor(open_lidar(f"rplidar://{lidar}", link, config), config)
    rng = np.random.default_rng(0)
    with Robot(link, config, [sensor]) as robot:
        for _ in range(2):  # the first one compiles
            robot.reset(Scene(), rng)
            robot.drive(0.0, 0.0)
            assert sensor.scan.ranges.shape == (config.lidar.rays,)
        reads: list[Read] = []
        for _ in range(ROUNDS):
            for arc in ARCS:
                for _ in range(ARC_STEPS):
                    for _ in range(10):
                        robot.drive(*arc)
                    reads.append(Read(link.now(), sensor.revolution))
            robot.drive(0.0, 0.0)
            time.sleep(0.1)  # the log knows what was read
            way = follow(emulated, config)
            timely = [
                read for read in reads if way.was_timely(read.revolution.stamp - 0.3, read.now)
            ]
            if len(timely) >= ENOUGH:
                break
    return timely, way


def simulate(
    way: Way, read: Read, world: World, config: RobotConfig
) -> tuple[Floats, Floats, Floats]:
    """Rays of the simulated LiDAR and of the emulated one, both moved by the true poses [m].

    And when the simulated one measured each, in the time of the movers' episode [s].
    """
    spec, rays, trail = ray_spec(config), make_rays(config), way.trail(read.now, config.period)
    around = make_surroundings(Obstacles(world.circles, world.segments), spec, 1, config)
    beams = make_beams(spec.rays)
    aim_beams(trail, ROWS - 1, read.revolution.stamp, 1.0 / config.lidar.rate, rays, beams)
    _, x, y, heading = trail[-1].tolist()
    cos, sin = cos_sin(heading)
    cast_lines(x, y, cos, sin, 0, around, beams.origins, beams.distances)
    since = read.now - np.interp(read.now, way.times, way.episode)
    in_episode = beams._replace(times=beams.times - since)
    crowd = Crowd(world, config, KEY)
    movers, pieces = crowd.motions.movers[0], crowd.motions.pieces[0]
    passers = Passers(movers, pieces, crowd.states, np.zeros((ROWS, len(movers), 2)))
    place = *lidar_place(x, y, cos, sin, config), cos, sin
    see_passers(passers, trail, ROWS - 1, place, rays, around.directions[0], in_episode)
    add_errors(beams.distances, 0.0, 0.0, NO_ERRORS, rays)
    found = np.empty((2, spec.rays))
    for measured, ranges in zip((beams, read.revolution), found, strict=True):
        fill_scan(*measured[:3], trail, ROWS - 1, rays, ranges)
    return found[0], found[1], in_episode.times


def lidar_place(
    x: float, y: float, cos: float, sin: float, config: RobotConfig
) -> tuple[float, float]:
    """Where the LiDAR of a robot is [m]."""
    ahead, left = config.lidar_x_offset, config.lidar_y_offset
    return x + cos * ahead - sin * left, y + sin * ahead + cos * left


def look_beside(
    way: Way, read: Read, times: Floats, world: World, config: RobotConfig
) -> tuple[Floats, Floats]:
    """Exact ranges along the rays and to both sides of them, as far as the next measurement [m].

    Returns:
        (9, rays): with the movers where they were at these times; and without any.
    """
    lidar = config.lidar
    _, x, y, heading = way.trail(read.now, config.period)[-1].tolist()
    place = lidar_place(x, y, *cos_sin(heading), config)
    bearings = ray_spec(config).angles() + heading
    shares = [hash_sample(KEY, number) for number in range(len(world.movers))]
    movers = list(zip(world.movers, shares, strict=True))
    moved = np.array([[one.position(t, share) for one, share in movers] for t in times.tolist()])
    moved = moved.reshape(len(times), len(movers), 2)
    beside = np.array(
        [
            [measure_ranges(place, bearings + off * SPACING, world, of) for off in OFFS]
            for of in (moved, None)
        ]
    )
    with_movers, without = np.clip(beside, lidar.min_range, lidar.max_range)
    return with_movers, without


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["clutter", "rooms", "walkers:walkers"])
def test_both_lidars_see_the_same_at_the_same_time(
    start_emulator: StartEmulator, kind: str
) -> None:
    """An A1 measures every 1.8 degrees, so where an edge is between two of them nobody knows."""
    config = RobotConfig.preset("acsar").with_(
        lidar={"noise": 0.0, "timeout": 5.0}, watchdog_timeout=10.0, feedback_timeout=5.0
    )
    name = f"{kind}:3-3"
    emulated = start_emulator("--world", name, "--key", str(KEY), "--lidar")
    assert emulated.process.stdout is not None
    lidar = emulated.process.stdout.readline().strip().split(" ")[-1]
    reads, way = drive_arcs(emulated, lidar, config)
    if len(reads) < ENOUGH:
        pytest.skip("this machine is too busy for an emulator in real time")
    world = Pool.of(name, None, footprint_radius(config), 1)[3]
    stamps = np.array([read.revolution.stamp for read in reads])
    late = np.array([stamp - way.ends[np.abs(way.ends - stamp).argmin()] for stamp in stamps])
    assert np.mean(np.abs(late) < 0.005) > 0.95
    pairs = np.array([simulate(way, read, world, config) for read in reads])
    looks = [
        look_beside(way, read, times, world, config)
        for read, times in zip(reads, pairs[:, 2], strict=True)
    ]
    beside, standing = np.swapaxes(looks, 0, 1)
    errors = np.abs(pairs[:, 0] - pairs[:, 1])
    plain = np.abs(np.diff(beside, axis=1)).max(axis=1) < JUMP
    assert plain.mean() > 0.6
    on_movers = (beside != standing).all(axis=1)
    assert bool(world.movers) == (on_movers.mean() > 0.1)
    assert np.median(errors) < 0.01
    assert np.percentile(errors[plain], 95.0) < 0.04
    if world.movers:
        moved = errors[plain & on_movers]
        median, most = np.median(moved), np.percentile(moved, 95.0)
        print(f"{len(moved)} rays on movers: median {median:.4f} m, 95 % {most:.4f} m")
        assert median < 0.02
        assert most < 0.05
    # At an edge it is the range on one of its sides, or between them.
    beyond = np.maximum(beside.min(axis=1) - pairs[:, 1], pairs[:, 1] - beside.max(axis=1))
    print(
        f"{len(reads)} scans: median {np.median(errors):.4f} m, 95 % "
        f"{np.percentile(errors, 95):.4f} m, away from edges {np.percentile(errors[plain], 95):.4f}"
        f" m, beyond what is beside {np.percentile(beyond, 95):.4f} m, stamps "
        f"{np.percentile(late, [5, 50, 95]).round(4).tolist()} s"
    )
    assert np.percentile(beyond, 95.0) < 0.04
