"""The same scenes over ROS 2 and without it, with real processes; `make ros-scenes`.

Emulated: a board and its LiDAR on pseudo-terminals, `acsar-gym ros driver` on them, `acsar-gym ros
policy` beside it; the same scenes over `--link planar`. Of a robot that touched an obstacle, by the
board's log, no goal counts as reached. The odometry of each step of the policy is compared with the
message on /odom that has the same stamp.

PyBullet: `acsar-gym evaluate --link ros2` with `acsar-gym ros driver --link bullet`, and `--link
bullet` alone.

Time is real: twenty scenes are five minutes for each row. Prints a table; the exit code is 1 where
a limit is exceeded.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import ros_tools
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.time import Time
from ros_tools import Client, Heard, Program

from acsar_gym.config import RobotConfig
from acsar_gym.testing import TIMEOUT
from acsar_gym.tools.benchmark.runner import PORT_TOUCH_DISTANCE
from acsar_gym.tools.cli import main as run_command
from acsar_gym.tools.emulation.board import PATIENCE, run_emulator
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episode import footprint_clearance, read_true_poses
from acsar_gym.tools.ros import policy as ros_policy
from acsar_gym.worlds import Pose, Region
from acsar_gym.worlds.files import save_world
from acsar_gym.worlds.world import to_odometry

POLICIES = ("point_goal", "obstacle_goal")
MOST_FEWER = 1
"""So many scenes may end otherwise."""
MOST_APART = 1e-9
"""Largest difference of odometries [m, rad]."""
LONGEST_DRIVE = 300.0
"""Of one scene, with the start of its processes [s]."""
LOG_VARIABLE = "COMPARE_SCENES_LOG"


class LoggedEnv(ros_policy.WatchedEnv):
    """Writes the odometry after each step, and the time of ROS at which its line was measured."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        result = super().reset(**options)
        self.note(begins=True)
        return result

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        result = super().step(action)
        self.note(begins=False)
        return result

    def note(self, *, begins: bool) -> None:
        inner: Any = self.env.unwrapped
        stamp = self._link.epoch + round(inner.robot.wire.measured * 1e9)
        line = {"stamp": stamp, "pose": inner.robot.odometry.pose, "begins": begins}
        with Path(os.environ[LOG_VARIABLE]).open("a") as log:
            log.write(json.dumps(line) + "\n")


@dataclass
class Row:
    """A row of the table."""

    name: str
    successes: list[bool]
    over_ros: list[bool]
    apart: float = float("nan")
    compared: int = 0
    faults: dict[int, str] = field(default_factory=dict)
    """Of the scenes that one ended."""

    @property
    def holds(self) -> bool:
        fewer = abs(sum(self.successes) - sum(self.over_ros))
        return fewer <= MOST_FEWER and not self.apart > MOST_APART

    def __str__(self) -> str:
        pairs = enumerate(zip(self.successes, self.over_ros, strict=True))
        otherwise = {scene: self.faults.get(scene, "") for scene, (a, b) in pairs if a != b}
        text = (
            f"{self.name}: {sum(self.over_ros)}/{len(self.over_ros)} over ros2, "
            f"{sum(self.successes)}/{len(self.successes)} without; otherwise: {otherwise or 'none'}"
        )
        if self.compared:
            text += f"; odometry apart by {self.apart:.1e} at most, at {self.compared} stamps"
        return text if self.holds else f"{text}: TOO MUCH"


def wait_for(client: Client, program: Program, what: str) -> int:
    """Hear until a program has ended; return its exit status."""
    others = [other for other in client.programs if other is not program]
    client.programs[:] = others
    try:
        client.wait(lambda: program.process.poll() is not None, what, LONGEST_DRIVE)
    finally:
        client.programs.append(program)
    return program.wait()


def compare_odometry(log: Path, odometry: Heard) -> list[float]:
    """How far the policy's odometry is from the driver's pose relative to that at the reset."""
    poses = {
        Time.from_msg(one.header.stamp).nanoseconds: one.pose.pose for one in odometry.messages
    }
    apart: list[float] = []
    start: Pose | None = None
    for line in map(json.loads, log.read_text().splitlines()):
        pose = poses.get(line["stamp"])
        there = None
        if pose is not None:
            theta = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
            there = pose.position.x, pose.position.y, theta
        if line["begins"]:
            start = there
        if there is None or start is None:
            continue
        x, y, theta = np.subtract(to_odometry(start, there), line["pose"]).tolist()
        apart.append(max(abs(x), abs(y), abs(math.remainder(theta, math.tau))))
    return apart


def has_ended(run: Program, count: int) -> bool:
    """Whether a policy's node has ended so many episodes, or refused a goal."""
    return run.printed.count("]: goal (") >= count or "refused" in run.printed


@contextlib.contextmanager
def started(client: Client, folder: Path, *arguments: object) -> Iterator[Program]:
    """A process, ended at the end."""
    program = Program(tuple(map(str, arguments)), folder)
    client.programs.append(program)
    try:
        yield program
    finally:
        client.programs.remove(program)
        program.send(15)
        with contextlib.suppress(Exception):
            program.wait()
        program.kill()


def results(path: Path) -> list[dict[str, Any]]:
    """The episodes in a file of `--json`."""
    return list(json.loads(path.read_text())["per_episode"])


def drive_without(policy: str, link: str, count: int) -> list[bool]:
    """Drive the scenes in a simulation; whether each goal was reached."""
    done = runs.evaluate_policy(runs.load_policy(policy, trust=False), link, None, range(count))
    return [episode.success for episode in done.results]


def drive_scene(
    policy: str, assignment: Any, number: int, client: Client, folder: Path, odometry: Heard
) -> tuple[bool, list[float]]:
    """Drive one scene with an emulated board, a driver and a policy of its own."""
    folder.mkdir()
    config, world = RobotConfig.of(None), assignment.world
    config.with_(**PATIENCE).save(folder / "robot.yaml")
    board_log, log, json_file = (folder / name for name in ("board.jsonl", "steps.jsonl", "r.json"))
    around: list[str] = []
    if world is not None:
        x, y, theta = assignment.start
        save_world(replace(world, start=Region(x, y, 0.0, theta)), folder / "world.json")
        around = ["--world", str(folder / "world.json"), "--lidar"]
    odometry.messages.clear()
    log.touch()
    os.environ[LOG_VARIABLE] = str(log)
    with run_emulator("--log", str(board_log), *around) as devices:
        robot = ("--robot", folder / "robot.yaml")
        lidar = ("--lidar", f"rplidar://{devices.lidar}") if devices.lidar else ()
        driver = ("-m", "acsar_gym", "ros", "driver", "--link", devices.robot, *robot, *lidar)
        goal = ("--goal", *map(repr, assignment.goal), "--once", "--yes", "--json", json_file)
        node = ("--policy", policy, *robot, *goal)
        with (
            started(client, folder, *driver),
            started(client, folder, __file__, "--node", *node) as run,
        ):
            wait_for(client, run, f"{policy}, scene {number}")
            if not json_file.exists():
                raise SystemExit(f"{policy}, scene {number}: {run.printed}")
            (episode,) = results(json_file)
    success = bool(episode["success"])
    if world is not None and world.obstacles:
        _, poses = read_true_poses(board_log)
        clearance = footprint_clearance(np.array(poses), config.outline, world)
        success = success and clearance >= PORT_TOUCH_DISTANCE
    return success, compare_odometry(log, odometry)


def drive_open(
    policy: str, assignments: list[Any], client: Client, folder: Path, odometry: Heard
) -> tuple[list[bool], list[float]]:
    """Drive scenes without a world one after the other: goals are heard, relative to the robot."""
    folder.mkdir()
    RobotConfig.of(None).with_(**PATIENCE).save(folder / "robot.yaml")
    log, json_file = folder / "steps.jsonl", folder / "r.json"
    log.touch()
    os.environ[LOG_VARIABLE] = str(log)
    robot = ("--robot", folder / "robot.yaml")
    count = len(assignments)
    node = ("--policy", policy, *robot, "--episodes", count, "--json", json_file)
    with run_emulator() as devices:
        driver = ("-m", "acsar_gym", "ros", "driver", "--link", devices.robot, *robot)
        with (
            started(client, folder, *driver),
            started(client, folder, __file__, "--node", *node) as run,
        ):
            goals = client.publisher(PoseStamped, "/goal_pose")
            client.wait(lambda: "waits for goals" in run.printed, "the policy")
            for number, assignment in enumerate(assignments):
                message = PoseStamped()
                message.header.frame_id = "base_link"
                message.pose.position.x, message.pose.position.y = assignment.goal
                goals.publish(message)
                if number < count - 1:
                    ends = partial(has_ended, run, number + 1)
                    client.wait(ends, f"scene {number}", LONGEST_DRIVE)
            wait_for(client, run, "the last scene")
    return [bool(episode["success"]) for episode in results(json_file)], compare_odometry(
        log, odometry
    )


def compare_emulated(policy: str, count: int, client: Client, folder: Path) -> Row:
    """Driver over an emulated board, policy node beside it; and planar robots."""
    env: Any = runs.make_env(runs.load_policy(policy, trust=False), "planar", None, {})
    assignments = []
    with contextlib.closing(env):
        for seed in range(count):
            env.reset(seed=seed)
            assignments.append(env.unwrapped.episode.assignment)
    odometry = client.hear(Odometry, "/odom")
    row = Row(f"{policy} over an emulated board", drive_without(policy, "planar", count), [])
    if all(one.world is None for one in assignments):
        row.over_ros, apart = drive_open(policy, assignments, client, folder / policy, odometry)
    else:
        apart = []
        for number, assignment in enumerate(assignments):
            place = folder / f"{policy}{number}"
            success, differences = drive_scene(policy, assignment, number, client, place, odometry)
            row.over_ros.append(success)
            apart += differences
            print(
                f"{policy}, scene {number}: {success}, planar {row.successes[number]}", flush=True
            )
    row.apart, row.compared = max(apart, default=float("inf")), len(apart)
    return row


def compare_bullet(policy: str, count: int, client: Client, folder: Path) -> Row:
    """`evaluate --link ros2` with PyBullet behind the driver, and PyBullet alone."""
    folder.mkdir()
    json_file = folder / "r.json"
    RobotConfig.of(None).with_(**PATIENCE).save(folder / "robot.yaml")
    driver = ("-m", "acsar_gym", "ros", "driver", "--link", "bullet")
    evaluate = ("-m", "acsar_gym", "evaluate", "--policy", policy, "--link", "ros2")
    with started(client, folder, *driver) as driving:
        client.wait(lambda: "drives bullet" in driving.printed, "the driver", 4 * TIMEOUT)
        given = ("--episodes", count, "--json", json_file, "--robot", folder / "robot.yaml")
        with started(client, folder, *evaluate, *given) as run:
            client.programs.remove(run)  # a wait fails where one of them ends
            client.wait(lambda: run.process.poll() is not None, policy, count * LONGEST_DRIVE)
            client.programs.append(run)
            if not json_file.exists():
                raise SystemExit(f"{policy}, PyBullet: {run.printed}")
    driven = results(json_file)
    over_ros = [bool(episode["success"]) for episode in driven]
    over_ros += [False] * (count - len(over_ros))
    row = Row(f"{policy} with PyBullet", drive_without(policy, "bullet", count), over_ros)
    row.faults = {number: one["fault"] for number, one in enumerate(driven) if one["fault"]}
    return row


def main() -> None:
    """Drive and print."""
    if sys.argv[1:2] == ["--node"]:  # the command, with a log
        ros_policy.WatchedEnv = LoggedEnv  # type: ignore[misc]
        sys.argv[1:2] = ["ros", "policy"]
        run_command()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--policies", nargs="+", default=POLICIES)
    parser.add_argument("--rows", nargs="+", default=["emulated", "bullet"])
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name, ros_tools.client("/", []) as client:
        for policy in given.policies:
            for kind in given.rows:
                compare = compare_emulated if kind == "emulated" else compare_bullet
                folder = Path(name) / f"{policy}-{kind}"
                if kind == "emulated":
                    folder.mkdir()
                rows.append(compare(policy, given.scenes, client, folder))
                print(rows[-1], flush=True)
    print("", *rows, sep="\n")
    sys.exit(0 if all(row.holds for row in rows) else 1)


if __name__ == "__main__":
    main()
