"""Scan matching, and runs that a LiDAR measures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sysid_tools import ACSAR

from acsar_gym import RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.sensors.lidar import SimulatedLidar
from acsar_gym.tools.sysid.calibration_drive import (
    RunPlan,
    TruthObserver,
    drive_run,
    plan_squares,
    plan_straights,
    plan_turns,
)
from acsar_gym.tools.sysid.calibration_runs import RunReading
from acsar_gym.tools.sysid.delays import Floats
from acsar_gym.tools.sysid.scan_matching import (
    LidarObserver,
    ReferenceScan,
    scan_points,
    with_fine_scans,
)
from acsar_gym.worlds import Pose, Scene, World

ROOM = np.array(
    [(-2, -2, 4, -2), (4, -2, 4, 2), (4, 2, -2, 2), (-2, 2, -2, -2), (3, 1, 3.5, 1)], np.float64
)
CORRIDOR = np.array([(-20, -1, 20, -1), (-20, 1, 20, 1)], np.float64)
FINE = with_fine_scans(ACSAR)
ORIGIN = (0.0, 0.0, 0.0)


def scan(pose: Pose) -> Floats:
    """Points that the robot's LiDAR sees in the room, in the base frame, without noise."""
    exact = FINE.with_(lidar={"noise": 0.0})
    link = open_link("planar", exact)
    scene = Scene(pose, world=World(segments=ROOM))
    link.reset(scene)
    lidar = SimulatedLidar(link, exact)
    lidar.reset(scene, np.random.default_rng(0))
    return scan_points(lidar.scan().ranges, exact)


@pytest.mark.parametrize("pose", [ORIGIN, (0.2, -0.1, 0.1), (-0.1, 0.2, -0.25)])
def test_a_scan_tells_where_it_was_taken(pose: Pose) -> None:
    found = ReferenceScan(scan(ORIGIN)).match(scan(pose), ORIGIN)
    assert found.pose == pytest.approx(pose, abs=2e-3)
    assert found.share > 0.8
    assert max(found.sigma) < 0.01


def test_the_frame_is_the_robot_s_and_not_the_lidar_s() -> None:
    """Turning in place doesn't move the robot, though its LiDAR is 15 cm behind."""
    found = ReferenceScan(scan(ORIGIN)).match(scan((0.0, 0.0, 0.3)), (0, 0, 0.2))
    assert found.pose == pytest.approx((0.0, 0.0, 0.3), abs=2e-3)


def test_rays_that_meet_nothing_are_left_out() -> None:
    ranges = np.full(FINE.lidar.rays, FINE.lidar.max_range)
    assert len(scan_points(ranges, FINE)) == 0
    ranges[FINE.lidar.rays // 2] = 1.0
    expected = np.array([[1.0 + FINE.lidar_x_offset, 0.0]])
    assert scan_points(ranges, FINE) == pytest.approx(expected)


def test_nothing_in_common_is_no_match() -> None:
    found = ReferenceScan(scan(ORIGIN)).match(np.full((50, 2), 100.0), ORIGIN)
    assert not math.isfinite(found.sigma[0])


class Both(LidarObserver):
    """A LiDAR, beside the truth."""

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(config)
        self.truth = TruthObserver()
        self.told: list[RunReading] = []

    def begin(self, robot: Robot) -> None:
        self.truth.begin(robot)
        super().begin(robot)

    def tick(self, robot: Robot) -> None:
        super().tick(robot)
        self.truth.tick(robot)

    def readings(self, plan: RunPlan) -> list[RunReading]:
        self.told = self.truth.readings(plan)
        return super().readings(plan)


@pytest.mark.parametrize(
    "plan",
    [
        plan_straights(0.8, 0.4, 1)[0],
        plan_turns(1.5, (1.2,), (0.0,), 1)[0],
        plan_squares(0.4, 0.4, 1.0, 0, 1)[0],
    ],
    ids=lambda plan: plan.manoeuvre,
)
def test_a_lidar_measures_runs_of_a_robot_that_odometry_is_wrong_about(plan: RunPlan) -> None:
    twin = FINE.with_(wheelbase=0.28, wheel_radius=0.051)
    observer = Both(FINE)
    scene = Scene((0.5, -0.5, 0.4), world=World(segments=ROOM))
    with Robot(open_link("planar", twin), FINE, ["lidar"]) as robot:
        run = drive_run(robot, plan, scene, observer)
    found = {reading.kind: reading.value for reading in run.readings}
    true = {reading.kind: reading.value for reading in observer.told}
    assert found == pytest.approx(true, abs=5e-3)


@pytest.mark.parametrize(
    ("segments", "said"),
    [(np.zeros((0, 4)), "sees 0 points within 5 m"), (CORRIDOR, "as in a long corridor")],
    ids=["nothing", "corridor"],
)
def test_scans_that_tell_too_little_are_errors(segments: Floats, said: str) -> None:
    plan = plan_straights(0.3, 0.5, 1)[0]
    scene = Scene(world=World(segments=segments))
    with (
        Robot(open_link("planar", FINE), FINE, ["lidar"]) as robot,
        pytest.raises(LidarError, match=said),
    ):
        drive_run(robot, plan, scene, LidarObserver(FINE))
