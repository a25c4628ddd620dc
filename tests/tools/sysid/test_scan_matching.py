"""Scan matching, and runs that a LiDAR measures."""

from __future__ import annotations

import numpy as np
import pytest
from sysid_tools import ACSAR

from acsar_gym.errors import LidarError
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.tools.sysid.calibration_drive import (
    RunPlan,
    TruthObserver,
    drive_run,
    plan_squares,
    plan_straights,
    plan_turns,
)
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
    lidar = LidarSensor(SimulatedLidar(link, exact), exact)
    lidar.reset(scene, np.random.default_rng(0))
    lidar.poll(link.truth, link.now())
    return scan_points(lidar.scan.ranges, exact)


@pytest.mark.parametrize("pose", [ORIGIN, (0.2, -0.1, 0.1), (-0.1, 0.2, -0.25), (0.0, 0.0, 0.3)])
def test_a_scan_tells_where_the_robot_was_and_not_its_lidar(pose: Pose) -> None:
    found = ReferenceScan(scan(ORIGIN)).match(scan(pose), (0.0, 0.0, 0.5 * pose[2]))
    assert found.pose == pytest.approx(pose, abs=2e-3)
    assert found.share > 0.8
    assert max(found.sigma) < 0.01


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
    scene = Scene((0.5, -0.5, 0.4), world=World(segments=ROOM))
    found = []
    for observer in (LidarObserver(FINE), TruthObserver()):
        with Robot(open_link("planar", twin), FINE, ["lidar"]) as robot:
            run = drive_run(robot, plan, scene, observer)
        found.append({reading.kind: reading.value for reading in run.readings})
    assert found[0] == pytest.approx(found[1], abs=5e-3)


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
