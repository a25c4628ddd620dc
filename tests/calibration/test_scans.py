"""Scan matching, and runs that a LiDAR measures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibration_tools import ACSAR

from acsar_gym import RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.sensors.lidar import SimulatedLidar
from acsar_gym.tools.sysid import calibration_drive
from acsar_gym.tools.sysid.calibration_drive import TruthObserver, drive_run
from acsar_gym.tools.sysid.calibration_runs import Floats, RunReading
from acsar_gym.tools.sysid.scan_matching import (
    LidarObserver,
    ReferenceScan,
    scan_points,
    with_fine_scans,
)
from acsar_gym.worlds import Pose, Scene, World
from acsar_gym.worlds.world import to_world

ROOM = np.array(
    [(-2, -2, 4, -2), (4, -2, 4, 2), (4, 2, -2, 2), (-2, 2, -2, -2), (3, 1, 3.5, 1)], np.float64
)
CORRIDOR = np.array([(-20, -1, 20, -1), (-20, 1, 20, 1)], np.float64)
FINE = with_fine_scans(ACSAR)


def scan(pose: Pose, segments: Floats, config: RobotConfig = FINE) -> Floats:
    """Points that the robot's LiDAR sees, in the base frame, without noise."""
    exact = config.with_(lidar={"noise": 0.0})
    link = open_link("planar", exact)
    scene = Scene(pose, world=World(segments=segments))
    link.reset(scene)
    lidar = SimulatedLidar(link, exact)
    lidar.reset(scene, np.random.default_rng(0))
    return scan_points(lidar.scan().ranges, exact)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.1), (-0.1, 0.2, -0.25)])
def test_a_scan_tells_where_it_was_taken(pose: Pose) -> None:
    found = ReferenceScan(scan((0.0, 0.0, 0.0), ROOM)).match(scan(pose, ROOM), (0.0, 0.0, 0.0))
    assert found.pose == pytest.approx(pose, abs=2e-3)
    assert found.share > 0.8
    assert max(found.sigma) < 0.01


def test_the_frame_is_the_robot_s_and_not_the_lidar_s() -> None:
    """Turning in place doesn't move the robot, though its LiDAR is 15 cm behind."""
    found = ReferenceScan(scan((0.0, 0.0, 0.0), ROOM)).match(
        scan((0.0, 0.0, 0.3), ROOM), (0, 0, 0.2)
    )
    assert found.pose == pytest.approx((0.0, 0.0, 0.3), abs=2e-3)


def test_rays_that_meet_nothing_are_left_out() -> None:
    ranges = np.full(FINE.lidar.rays, FINE.lidar.max_range)
    assert len(scan_points(ranges, FINE)) == 0
    ranges[FINE.lidar.rays // 2] = 1.0
    assert scan_points(ranges, FINE) == pytest.approx(np.array([[1.0 + FINE.lidar_x_offset, 0.0]]))


def test_nothing_in_common_is_no_match() -> None:
    here = ReferenceScan(scan((0.0, 0.0, 0.0), ROOM))
    assert not math.isfinite(here.match(np.full((50, 2), 100.0), (0.0, 0.0, 0.0)).sigma[0])


class Both(LidarObserver):
    """A LiDAR, beside the truth."""

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(config)
        self.truth = TruthObserver()
        self.told: list[RunReading] = []

    def begin(self, robot: Robot) -> None:
        super().begin(robot)
        self.truth.begin(robot)

    def tick(self, robot: Robot) -> None:
        super().tick(robot)
        self.truth.tick(robot)

    def readings(self, plan: calibration_drive.RunPlan) -> list[RunReading]:
        self.told = self.truth.readings(plan)
        return super().readings(plan)


@pytest.mark.parametrize(
    "plan",
    [
        calibration_drive.plan_straights(0.8, 0.4, 1)[0],
        calibration_drive.plan_turns(1.5, (1.2,), (0.0,), 1)[0],
        calibration_drive.plan_squares(0.4, 0.4, 1.0, 0, 1)[0],
    ],
    ids=lambda plan: plan.manoeuvre,
)
def test_a_lidar_measures_runs_of_a_robot_that_odometry_is_wrong_about(
    plan: calibration_drive.RunPlan,
) -> None:
    twin = FINE.with_(wheelbase=0.28, wheel_radius=0.051)
    observer = Both(FINE)
    scene = Scene((0.5, -0.5, 0.4), world=World(segments=ROOM))
    robot = Robot(open_link("planar", twin), FINE, ["lidar"])
    with robot:
        run = drive_run(robot, plan, scene, observer)
    found = {reading.kind: reading.value for reading in run.readings}
    true = {reading.kind: reading.value for reading in observer.told}
    assert found == pytest.approx(true, abs=5e-3)


def measured(segments: Floats, distance: float) -> None:
    plan = calibration_drive.plan_straights(distance, 0.5, 1)[0]
    with Robot(open_link("planar", FINE), FINE, ["lidar"]) as robot:
        drive_run(robot, plan, Scene(world=World(segments=segments)), LidarObserver(FINE))


def test_scans_that_tell_too_little_are_errors() -> None:
    with pytest.raises(LidarError, match="sees 0 points within 5 m: calibrate in a room"):
        measured(np.zeros((0, 4)), 0.3)
    with pytest.raises(LidarError, match="don't tell where the robot is, as in a long corridor"):
        measured(CORRIDOR, 0.3)


def test_poses_are_composed() -> None:
    assert to_world((1.0, 0.0, math.pi / 2), (1.0, 0.0, 0.0)) == pytest.approx(
        (1.0, 1.0, math.pi / 2)
    )
