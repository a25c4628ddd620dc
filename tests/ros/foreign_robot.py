"""A ROS robot that isn't ours, as a process: `foreign_robot.py LOG OPTIONS`.

It has a diff-drive controller, wheels, and a LiDAR in a room. It knows rclpy and numpy, and nothing
of acsar_gym, so that both can't be wrong together. It takes commands as ros2_controllers do, has
them take effect after a true dead time, turns its wheels, and publishes joint_states, odom, /tf,
/tf_static and scan. Its true pose is integrated with the true multiplier of the wheel separation,
and its odometry with that of the controller.

The log gets a JSON line for each command received and for each state of the wheels, with the
monotonic time, which all processes of a computer share:

    {"monotonic": 12.34, "command": [0.2, 0.0]}      # or wheel speeds, and a reason in "refused"
    {"monotonic": 12.35, "speeds": [3.9, ...], "pose": [x, y, theta]}

The options are a JSON object with some of the keys of `DEFAULTS`.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import rclpy
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_msgs.msg import Float64MultiArray, Header
from tf2_msgs.msg import TFMessage

Array = npt.NDArray[np.float64]
Pose = tuple[float, float, float]
RADIUS = 0.05
SEPARATION = 0.3
SCAN_X = 0.1  # the LiDAR's place before the axle [m]
SCAN_RAYS = 360
CLOCK_RATE = 200.0  # of /clock, in its own seconds [Hz]
STEP = 0.002  # longest step of the integration [s]
JUMP = 5.0  # how far the clock jumps back [s]
SIM_EPOCH = 100  # the first time of /clock [s]
ROOM = (-2.0, -1.5, 4.0, 2.5)  # least x and y, largest x and y of the walls [m]
COMMANDS = {"twist": Twist, "twist_stamped": TwistStamped, "wheel_speeds": Float64MultiArray}
DEFAULTS: dict[str, Any] = {
    "namespace": "",
    "remap": "",  # of a topic, as any node's
    # Joints in the order of joint_states: NAME=WHEEL with the wheel a, b, c, d, left or right. A
    # NAME alone is a joint of an arm.
    "joints": ["right_front=a", "left_front=b", "left_rear=c", "right_rear=d"],
    "command": "twist_stamped",
    "command_topic": "cmd_vel",
    "command_qos": "reliable",  # or best_effort, or transient_local
    "cmd_vel_timeout": 0.5,
    "delay": 0.0,  # dead time between command and motor [s]
    "time_constant": 0.05,  # of the wheels [s]
    "multiplier": 1.0,  # the controller's, of the separation
    "true_multiplier": 0.0,  # the world's. 0: that of the controller
    "rate": 50.0,  # of joint_states and odom [Hz]
    "odom_only": False,  # no joint_states
    "qos": "reliable",  # of the sensors, or best_effort
    "frame": "base_link",
    "scan_yaw": None,  # how the LiDAR is turned [rad]. None: no LiDAR
    "mast": False,  # another frame between base and LiDAR, which is turned as well
    "static": "/tf_static",  # the topic of the LiDAR's transform
    "sim_time": 0.0,  # publishes /clock, as a multiple of real time
    # Times of faults [s], from the first command that moves the robot. 0: at once.
    "clock_jump_after": None,
    "nan_after": None,  # the first wheel's speed is NaN
    "missing_joint": "",
    "missing_after": 0.0,
    "drop_after": None,  # publishes nothing any more
}


class World:
    """Wheels that follow their targets, and the body that they carry."""

    def __init__(self, config: SimpleNamespace) -> None:
        wheels = [joint.split("=")[1] for joint in config.joints if "=" in joint]
        self.right = np.array([wheel in {"a", "d", "right"} for wheel in wheels])
        self.time_constant = config.time_constant
        self.width = SEPARATION * (config.true_multiplier or config.multiplier)
        self.time = 0.0
        self.targets = np.zeros(len(wheels))
        self.speeds = np.zeros(len(wheels))
        self.angles = np.zeros(len(wheels))
        self.pose = (0.0, 0.0, 0.0)
        self.events: deque[tuple[float, Array]] = deque()
        """When the motors get which targets."""

    def body(self, speeds: Array, width: float) -> tuple[float, float]:
        """Linear and angular velocity, or way and angle, of wheels that don't slip."""
        sides = [RADIUS * float(speeds[side].mean()) for side in (self.right, ~self.right)]
        return sum(sides) / 2.0, (sides[0] - sides[1]) / width

    def wheels(self, linear: float, angular: float, width: float) -> Array:
        """Speeds of the wheels for a twist."""
        turn = np.where(self.right, 0.5, -0.5) * angular * width
        return np.asarray((linear + turn) / RADIUS)

    def advance(self, until: float) -> None:
        """Integrate, event by event, in short steps."""
        while True:
            while self.events and self.events[0][0] <= self.time:
                self.targets = self.events.popleft()[1]
            end = min(until, self.time + STEP, *(event[0] for event in list(self.events)[:1]))
            dt = end - self.time
            if dt <= 0.0:
                return

            # The lag is solved exactly, so that steps may be long.
            decay = math.exp(-dt / self.time_constant)
            lag = self.speeds - self.targets
            turned = self.targets * dt + lag * self.time_constant * (1.0 - decay)
            self.speeds = self.targets + lag * decay
            self.angles = self.angles + turned
            self.pose = moved(self.pose, *self.body(turned, self.width))
            self.time = end

    def scan(self, angles: Array) -> Array:
        """Distance of the walls [m] at angles from the body."""
        x, y, theta = self.pose
        cosine = np.cos(theta + angles)
        sine = np.sin(theta + angles)
        with np.errstate(divide="ignore"):
            to_x = (
                np.where(cosine > 0.0, ROOM[2], ROOM[0]) - x - SCAN_X * math.cos(theta)
            ) / cosine
            to_y = (np.where(sine > 0.0, ROOM[3], ROOM[1]) - y - SCAN_X * math.sin(theta)) / sine
        return np.asarray(np.minimum(np.abs(to_x), np.abs(to_y)))


def moved(pose: Pose, way: float, angle: float) -> Pose:
    """The pose after a short arc."""
    x, y, theta = pose
    middle = theta + angle / 2.0
    return x + way * math.cos(middle), y + way * math.sin(middle), theta + angle


def transform(header: Header, child: str, pose: Pose) -> TransformStamped:
    """A transform in the plane."""
    x, y, yaw = pose
    rotation = Quaternion(z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))
    placed = TransformStamped(header=header, child_frame_id=child)
    placed.transform = Transform(rotation=rotation)
    placed.transform.translation.x = x
    placed.transform.translation.y = y
    return placed


class ForeignRobot:
    """The node: everything in one thread, at absolute deadlines."""

    def __init__(self, log: str, config: SimpleNamespace) -> None:
        self.config = config
        self.world = World(config)
        self.controller_width = SEPARATION * config.multiplier
        self.odometry = (0.0, 0.0, 0.0)
        self.odometry_angles = self.world.angles
        self.first_command = math.inf
        self.log = open(log, "w", buffering=1)  # noqa: SIM115
        self.speed = config.sim_time or 1.0
        self.start = time.monotonic()
        self.epoch = SIM_EPOCH * 10**9 if config.sim_time else time.time_ns()

        self.node = node = rclpy.create_node("foreign_robot", namespace=config.namespace)
        sensors = QoSProfile(depth=10, reliability=ReliabilityPolicy[config.qos.upper()])
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.joint_states = None
        if not config.odom_only:
            self.joint_states = node.create_publisher(JointState, "joint_states", sensors)
        self.odom = node.create_publisher(Odometry, "odom", sensors)
        self.tf = node.create_publisher(TFMessage, "/tf", 100)

        self.periods: dict[Callable[[float], None], float] = {}
        """How often each topic is published [s]."""
        if config.sim_time:
            self.clock = node.create_publisher(Clock, "/clock", best_effort)
            self.periods[self.publish_clock] = 1.0 / CLOCK_RATE
        self.periods[self.publish_state] = 1.0 / config.rate
        if config.scan_yaw is not None:
            self.scan = node.create_publisher(LaserScan, "scan", sensors)
            self.tf_static = node.create_publisher(TFMessage, config.static, latched)
            self.tf_static.publish(TFMessage(transforms=self.mount()))
            self.periods[self.publish_scan] = 0.1
        qos = {"reliable": 10, "best_effort": best_effort, "transient_local": latched}
        node.create_subscription(
            COMMANDS[config.command], config.command_topic, self.receive, qos[config.command_qos]
        )

    def now(self) -> float:
        """Seconds of the robot's own clock since it started."""
        return (time.monotonic() - self.start) * self.speed

    def begun(self, after: float | None, now: float) -> bool:
        """Whether a fault is there."""
        return after is not None and (after == 0.0 or now - self.first_command >= after)

    def stamp(self, now: float) -> Time:
        """The time of ROS in the header of a message."""
        jump = JUMP if self.begun(self.config.clock_jump_after, now) else 0.0
        return Time(nanoseconds=self.epoch + round((now - jump) * 1e9))

    def write(self, now: float, **values: Any) -> None:
        self.log.write(json.dumps({"monotonic": self.start + now / self.speed} | values) + "\n")

    def receive(self, message: Any) -> None:
        """Check a command as ros2_controllers do, and have it take effect after the dead time."""
        now = self.now()
        world = self.world
        refusal = {}
        if self.config.command == "wheel_speeds":
            command = targets = np.array(message.data)
        else:
            twist = message.twist if self.config.command == "twist_stamped" else message
            command = np.array([twist.linear.x, twist.angular.z])
            targets = world.wheels(twist.linear.x, twist.angular.z, self.controller_width)

        if self.config.command == "twist_stamped":
            stamp = Time.from_msg(message.header.stamp).nanoseconds
            age = (self.stamp(now).nanoseconds - stamp) * 1e-9
            if stamp and abs(age) > self.config.cmd_vel_timeout:
                refusal = {"refused": f"it is {age:.3f} s old"}
        if len(targets) != len(world.targets) or not np.isfinite(targets).all():
            refusal = {"refused": f"speeds {targets}"}
        self.write(now, command=command.tolist(), **refusal)
        if refusal:
            return

        if any(command):
            self.first_command = min(self.first_command, now)
        # A command takes the place of the last one's time-out.
        start = now + self.config.delay
        while world.events and world.events[-1][0] > start:
            world.events.pop()
        world.events.append((start, targets))
        world.events.append((start + self.config.cmd_vel_timeout, np.zeros(len(targets))))

    def publish_clock(self, now: float) -> None:
        self.clock.publish(Clock(clock=self.stamp(now).to_msg()))

    def publish_state(self, now: float) -> None:
        """joint_states, odom and its transform, and a line in the log."""
        config = self.config
        world = self.world
        speeds = world.speeds.tolist()
        self.write(now, speeds=speeds, pose=world.pose)
        step = world.body(world.angles - self.odometry_angles, self.controller_width)
        self.odometry = moved(self.odometry, *step)
        self.odometry_angles = world.angles
        if self.begun(config.drop_after, now):
            return
        if self.begun(config.nan_after, now):
            speeds[0] = math.nan

        header = Header(stamp=self.stamp(now).to_msg(), frame_id="odom")
        placed = transform(header, config.frame, self.odometry)
        odom = Odometry(header=header, child_frame_id=config.frame)
        odom.pose.pose.position.x = placed.transform.translation.x
        odom.pose.pose.position.y = placed.transform.translation.y
        odom.pose.pose.orientation = placed.transform.rotation
        linear, angular = world.body(np.array(speeds), self.controller_width)
        odom.twist.twist.linear.x = linear
        odom.twist.twist.angular.z = angular
        self.odom.publish(odom)
        self.tf.publish(TFMessage(transforms=[placed]))
        if self.joint_states is None:
            return

        states = JointState(header=Header(stamp=header.stamp))
        wheels = iter(zip(world.angles.tolist(), speeds, strict=True))
        for joint in config.joints:
            name, *wheel = joint.split("=")
            position, velocity = next(wheels) if wheel else (0.5, 0.0)
            if name == config.missing_joint and self.begun(config.missing_after, now):
                continue
            states.name.append(name)
            states.velocity.append(velocity)
            states.position.append(position)
        self.joint_states.publish(states)

    def publish_scan(self, now: float) -> None:
        """All rays of a revolution at once."""
        increment = 2.0 * math.pi / SCAN_RAYS
        angles = -math.pi + increment * np.arange(SCAN_RAYS)
        scan = LaserScan(angle_min=-math.pi, angle_increment=increment, scan_time=0.1)
        scan.header.stamp = self.stamp(now).to_msg()
        scan.header.frame_id = "laser"
        scan.angle_max = -scan.angle_min - increment
        scan.range_min = 0.05
        scan.range_max = 12.0
        scan.ranges = self.world.scan(self.config.scan_yaw + angles).tolist()
        self.scan.publish(scan)

    def mount(self) -> list[TransformStamped]:
        """From the base to the LiDAR, over a mast if there is one."""
        base = Header(frame_id=self.config.frame)
        yaw = self.config.scan_yaw
        if not self.config.mast:
            return [transform(base, "laser", (SCAN_X, 0.0, yaw))]
        mast = Header(frame_id="mast")
        return [
            transform(base, "mast", (SCAN_X, 0.0, 1.5)),
            transform(mast, "laser", (0.0, 0.0, yaw - 1.5)),
        ]

    def run(self) -> None:
        """Publish at absolute deadlines, the clock first, and receive commands in between."""
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        dues = dict.fromkeys(self.periods, 0.0)
        while rclpy.ok():
            publish = min(dues, key=dues.__getitem__)
            while (remaining := dues[publish] - self.now()) > 0.0:
                executor.spin_once(timeout_sec=remaining / self.speed)
            self.world.advance(dues[publish])
            publish(dues[publish])
            dues[publish] += self.periods[publish]


def main() -> None:
    """Run until a signal ends it."""
    log, options = sys.argv[1:]
    config = SimpleNamespace(**DEFAULTS | json.loads(options))
    rclpy.init(args=["--ros-args", "-r", config.remap] if config.remap else None)
    with suppress(ExternalShutdownException, KeyboardInterrupt):
        ForeignRobot(log, config).run()


if __name__ == "__main__":
    main()
