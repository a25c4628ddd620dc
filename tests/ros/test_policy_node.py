"""`acsar-gym ros policy` next to robots of ours and of others: goals, refusals, ends."""

from __future__ import annotations

import json
import math
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as Plan
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_tools import Client, Program, StartProgram, StartRobot
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from acsar_gym import RobotConfig
from acsar_gym.recording.reader import read
from acsar_gym.testing import TIMEOUT

Place = tuple[float, float]
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENT = {"connect_timeout": 60.0, "feedback_timeout": 5.0, "watchdog_timeout": 5.0}
pytestmark = pytest.mark.usefixtures("deadline")


COMPILE_TIMEOUT = 300.0
"""Longest wait for a program that compiles for a LiDAR on a busy machine [s]."""


def wait_for_end(client: Client, program: Program, timeout: float = 3.0 * TIMEOUT) -> int:
    """Hear until a program has ended by itself, and return its exit status."""
    client.programs.remove(program)  # a wait fails where one of them ends
    try:
        client.wait(lambda: program.process.poll() is not None, "its end", timeout)
    finally:
        client.programs.append(program)
    return program.wait()


class PolicyTest:
    """A policy's node, and what a person in RViz sees and does."""

    def __init__(self, client: Client, program: Program) -> None:
        self.client = client
        self.program = program
        self.plans = client.hear(Plan, "plan")
        self.odometry = client.hear(Odometry, "odom")
        self.goals = client.publisher(PoseStamped, "goal_pose")
        self.wait_for("waits for goals")

    def wait_for(self, text: str, count: int = 1) -> None:
        self.client.wait(lambda: self.program.printed.count(text) >= count, text, 2.0 * TIMEOUT)

    def give(self, x: float, y: float, frame: str = "odom") -> None:
        goal = PoseStamped()
        goal.header.frame_id = frame
        goal.pose.position.x = x
        goal.pose.position.y = y
        self.goals.publish(goal)

    @property
    def place(self) -> Place:
        at = self.odometry.messages[-1].pose.pose.position
        return at.x, at.y

    def stands(self) -> bool:
        twist = self.odometry.messages[-1].twist.twist
        return bool(abs(twist.linear.x) < 0.01 and abs(twist.angular.z) < 0.01)

    def end(self) -> int:
        """Wait until the program has ended by itself."""
        return wait_for_end(self.client, self.program)


StartPolicy = Callable[..., PolicyTest]


@pytest.fixture
def robot_file(tmp_path: Path) -> Path:
    RobotConfig.of(None).with_(**PATIENT).save(tmp_path / "robot.yaml")
    return tmp_path / "robot.yaml"


@pytest.fixture
def driver(start_program: StartProgram, client: Client, namespace: str) -> Program:
    """A simulated robot."""
    command = ("-m", "acsar_gym", "ros", "driver", "--link", "planar", "--namespace", namespace)
    program = start_program(*command)
    client.wait(lambda: "drives planar" in program.printed, "the driver", 2.0 * TIMEOUT)
    return program


@pytest.fixture
def start_policy(
    start_program: StartProgram, client: Client, namespace: str, robot_file: Path
) -> StartPolicy:
    def start(*options: object, robot: Path = robot_file) -> PolicyTest:
        options = ("--robot", robot, "--namespace", namespace, *options)
        program = start_program("-m", "acsar_gym", "ros", "policy", *options)
        return PolicyTest(client, program)

    return start


def test_policy_drives_to_goals_and_shows_them(driver: Program, start_policy: StartPolicy) -> None:
    policy = start_policy("--episodes", 2)
    policy.give(1.2, 0.4)
    policy.wait_for("reached in")
    assert math.dist(policy.place, (1.2, 0.4)) < 0.2
    plan = policy.plans.messages[-1]
    assert plan.header.frame_id == "odom"
    last = plan.poses[-1].pose.position
    assert (last.x, last.y) == pytest.approx((1.2, 0.4), abs=0.02)
    first = policy.plans.messages[0].poses[0].pose.orientation
    assert 2.0 * math.atan2(first.z, first.w) == pytest.approx(math.atan2(0.4, 1.2), abs=0.3)
    policy.client.wait(policy.stands, "standing wheels")
    policy.give(-1.0, 0.0, "base_link")  # behind it
    assert policy.end() == 0
    assert "2/2" in policy.program.printed


def test_policy_refuses_goals_with_a_line(driver: Program, start_policy: StartPolicy) -> None:
    policy = start_policy("--episodes", 1)
    wrong = {
        (math.nan, 0.0, "odom"): "must be finite numbers",
        (50.0, 0.0, "odom"): "is 50 m away: must be 0.5 to 3 m",
        (1.0, 0.0, "nowhere"): "goal (1, 0) in 'nowhere': no transforms on /tf and /tf_static",
    }
    for count, (goal, line) in enumerate(wrong.items(), start=1):
        policy.give(*goal)
        policy.wait_for(line)
        assert policy.program.printed.count("refused: ") == count
    assert math.hypot(*policy.place) < 1e-6

    # A goal may come before the transform of its frame.
    transforms = policy.client.publisher(TFMessage, "tf")
    placed = TransformStamped(child_frame_id="late")
    placed.header.frame_id = "odom"
    placed.transform.rotation.w = 1.0
    policy.give(1.0, 0.0, "late")
    policy.client.spin(0.3)
    transforms.publish(TFMessage(transforms=[placed]))
    assert policy.end() == 0


def test_policy_replaces_a_goal_and_cancels(driver: Program, start_policy: StartPolicy) -> None:
    policy = start_policy("--episodes", 1)
    client = policy.client
    assert not client.call(Trigger, "acsar_policy/cancel").success
    policy.give(2.0, 0.0)
    client.wait(lambda: policy.place[0] > 0.3, "a robot that drives")
    policy.give(60.0, 0.0)  # isn't a goal, so the old one stays
    policy.wait_for("m away: must be")

    policy.give(0.5, 1.5)
    policy.wait_for("replaced by another goal")
    policy.wait_for("drives to goal (0.5, 1.5)")
    client.spin(0.5)
    assert client.call(Trigger, "acsar_policy/cancel").success
    client.wait(policy.stands, "standing wheels")
    assert policy.end() == 0
    assert "goal (0.5, 1.5) in 'odom': cancelled" in policy.program.printed
    assert math.dist(policy.place, (0.5, 1.5)) > 0.3


def test_policy_follows_a_goal_in_the_map(
    start_robot: StartRobot,
    start_policy: StartPolicy,
    client: Client,
    namespace: str,
    foreign_config: RobotConfig,
    tmp_path: Path,
) -> None:
    """The map is turned by a quarter, and moved, against the odometry. It is corrected later."""
    foreign = start_robot()
    foreign_config.with_(max_linear=0.8).save(tmp_path / "foreign.yaml")
    moved = TransformStamped(child_frame_id="odom")
    moved.header.frame_id = "map"
    moved.transform.translation.x = 4.0
    moved.transform.rotation.z = moved.transform.rotation.w = math.sqrt(0.5)
    corrections = client.node.create_publisher(TFMessage, f"{namespace}/tf", 10)
    client.node.create_publisher(TFMessage, f"{namespace}/tf_static", LATCHED).publish(
        TFMessage(transforms=[moved])
    )

    policy = start_policy("--episodes", 1, robot=tmp_path / "foreign.yaml")
    policy.give(4.0, 2.0, "map")  # 2 m ahead of the robot
    client.wait(lambda: policy.place[0] > 0.3, "a robot that drives")
    moved.transform.translation.y = 0.6
    corrections.publish(TFMessage(transforms=[moved]))
    assert policy.end() == 0, policy.program.printed
    client.wait(foreign.stands, "standing wheels")
    x, y, _ = foreign.states[-1]["pose"]
    assert math.dist((x, y), (1.4, 0.0)) < 0.25


def test_policy_reports_a_robot_that_ends_meanwhile(
    driver: Program, start_policy: StartPolicy
) -> None:
    policy = start_policy()
    policy.client.programs.remove(driver)
    driver.end(signal.SIGKILL)
    assert policy.end() == 3
    lines = [line for line in policy.program.printed.splitlines() if "acsar-gym: " in line]
    assert len(lines) == 1
    assert "Traceback" not in policy.program.printed


def test_policy_obeys_an_emergency_stop_while_it_waits(
    monkeypatch: pytest.MonkeyPatch,
    client: Client,
    start_program: StartProgram,
    driver: Program,
    start_policy: StartPolicy,
) -> None:
    with tempfile.TemporaryDirectory() as folder:  # its path is short enough for a socket
        monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", folder)  # stops no other robots
        policy = start_policy()
        client.programs.remove(policy.program)  # it ends as well
        stop = start_program("-m", "acsar_gym", "estop")
        assert stop.wait() == 0, stop.printed
        assert policy.program.wait() == 3
        client.programs.append(policy.program)
    assert "acsar-gym: emergency stop: look after the robot" in policy.program.printed


def test_run_over_ros_replays_the_same_observations(
    driver: Program,
    start_program: StartProgram,
    client: Client,
    namespace: str,
    robot_file: Path,
    tmp_path: Path,
) -> None:
    drive = tmp_path / "drive.mcap"
    replay = tmp_path / "replay.mcap"
    command = ("-m", "acsar_gym", "run", "1.0", "0.3", "--yes", "--robot", robot_file)
    for link, path in ((f"ros2:{namespace}", drive), (f"replay:{drive}", replay)):
        files = ("--link", link, "--record", path)
        run = start_program(*command, "--late-share", 1, *files)
        assert wait_for_end(client, run) == 0, run.printed

    for first, second in zip(read(drive).episodes, read(replay).episodes, strict=True):
        assert len(first.observations) > 5
        assert np.array_equal(first.observations, second.observations)


def test_evaluate_puts_a_simulated_robot_into_the_scenes(
    driver: Program,
    start_program: StartProgram,
    client: Client,
    namespace: str,
    robot_file: Path,
    tmp_path: Path,
) -> None:
    """The same goals and worlds as in simulation, with topics that are remapped."""
    results = []
    over_ros = ("ros2", "--ros-args", "-r", f"__ns:={namespace}")
    for link in (over_ros, ("planar",)):
        out = tmp_path / f"{link[0]}.json"
        options = ("--episodes", 2, "--late-share", 1, "--robot", robot_file, "--json", out)
        worlds = ("--worlds", "open:test")
        command = ("evaluate", "--policy", "obstacle_goal", *worlds, *options, "--link", *link)
        run = start_program("-m", "acsar_gym", *command)
        assert wait_for_end(client, run, COMPILE_TIMEOUT) == 0, run.printed
        results.append(json.loads(out.read_text())["per_episode"])
    for driven, simulated in zip(*results, strict=True):
        assert driven["success"]
        assert simulated["success"]
        assert driven["path"] == pytest.approx(simulated["path"], abs=0.1)
