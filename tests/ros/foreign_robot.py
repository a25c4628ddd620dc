"""A ROS robot that isn't ours, as a process: a diff-drive controller, wheels, a LiDAR in a room.

It knows rclpy and numpy, and nothing of acsar_gym, so that both can't be wrong together. It takes
commands as ros2_controllers do, has them take effect after a true dead time, turns its wheels, and
publishes joint_states, odom, /tf, /tf_static and scan. Its true pose is integrated with the true
multiplier of the wheel separation, and its odometry with that of the controller.

`--log FILE` gets a JSON line for each command received and for each state of the wheels, with the
monotonic time, which all processes of a computer share:

    {"monotonic": 12.34, "command": [0.2, 0.0]}      # or wheel speeds, and a reason in "refused"
    {"monotonic": 12.35, "speeds": [3.9, ...], "pose": [x, y, theta], "stamp": seconds}

Faults "after S" begin S seconds after the first command that moves it, or at once where S is 0.
Names of topics are remapped as those of any node: `--ros-args -r joint_states:=wheels`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
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
JOINTS = ["right_front=a", "left_front=b", "left_rear=c", "right_rear=d"]
RADIUS = 0.05
SEPARATION = 0.3
SCAN_X = 0.1  # the LiDAR's place before the axle [m]
CLOCK_RATE = 200.0  # of /clock, in its own seconds [Hz]
STEP = 0.002  # longest step of the integration [s]
JUMP = 5.0  # how far the clock jumps back [s]
SIM_EPOCH = 100  # what /clock begins with [s]
ROOM = (-2.0, -1.5, 4.0, 2.5)  # least x and y, largest x and y of the walls [m]
COMMANDS = {"twist": Twist, "twist_stamped": TwistStamped, "wheel_speeds": Float64MultiArray}


def options() -> tuple[argparse.Namespace, list[str]]:
    """This program's options, and those of ROS."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument

    add("--namespace", default="")
    add("--joints", nargs="+", default=JOINTS, help="in the order of joint_states: NAME=WHEEL with "
        "the wheel a, b, c, d, left or right; a NAME alone is a joint of an arm")  # fmt: skip
    add("--command", choices=COMMANDS, default="twist_stamped")
    add("--command-topic", default="cmd_vel")
    add("--command-qos", choices=["reliable", "best_effort", "transient_local"], default="reliable")
    add("--cmd-vel-timeout", type=float, default=0.5)
    add("--delay", type=float, default=0.0, help="dead time between command and motor [s]")
    add("--time-constant", type=float, default=0.05, help="of the wheels [s]")
    add("--multiplier", type=float, default=1.0, help="the controller's, of the separation")
    add("--true-multiplier", type=float, help="the world's; else that of the controller")
    add("--rate", type=float, default=50.0, help="of joint_states and odom [Hz]")
    add("--positions-only", action="store_true", help="joint_states have no velocities")
    add("--wrap", type=float, help="span of the positions, such as 6.2832 [rad]")
    add("--odom-only", action="store_true", help="no joint_states")
    add("--qos", choices=["reliable", "best_effort"], default="reliable", help="of the sensors")
    add("--frame", default="base_link")
    add("--scan-rate", type=float, default=0.0, help="0: no LiDAR [Hz]")
    add("--scan-rays", type=int, default=360)
    add("--scan-yaw", type=float, default=0.0, help="how the LiDAR is turned [rad]")
    add("--upside-down", action="store_true")
    add("--mast", action="store_true", help="a frame more between base and LiDAR, turned, too")
    add("--static", choices=["global", "namespaced", "none"], default="global", help="/tf_static")
    add("--scan-time-increment", type=float, default=0.0, help="between two rays [s]")
    add("--sim-time", type=float, help="publish /clock, so many times as fast as real time")
    add("--clock-jump-after", type=float, metavar="S", help="the clock jumps back")
    add("--nan-after", type=float, metavar="S", help="the first wheel's speed is NaN")
    add("--missing-joint", metavar="NAME", help="isn't in joint_states")
    add("--missing-after", type=float, default=0.0, metavar="S")
    add("--drop-after", type=float, metavar="S", help="publishes nothing any more")
    add("--log", default="/dev/null")
    return parser.parse_known_args()


class World:
    """Wheels that follow their targets, and the body that they carry."""

    def __init__(self, config: argparse.Namespace) -> None:
        wheels = [joint.split("=")[1] for joint in config.joints if "=" in joint]
        self.right = np.array([wheel in {"a", "d", "right"} for wheel in wheels])
        self.radius = RADIUS
        self.time_constant = config.time_constant
        self.width = SEPARATION * (config.true_multiplier or config.multiplier)
        self.time = 0.0
        self.targets = np.zeros(len(wheels))
        self.speeds = np.zeros(len(wheels))
        self.angles = np.zeros(len(wheels))
        self.pose = (0.0, 0.0, 0.0)
        self.events: deque[tuple[float, Array]] = deque()
        """When the motors get which targets."""
        self.past: deque[tuple[float, float, float, float]] = deque([(0.0, 0.0, 0.0, 0.0)], 1000)

    def body(self, speeds: Array, width: float) -> tuple[float, float]:
        """Linear and angular velocity, or way and angle, of wheels that don't slip."""
        sides = [self.radius * float(speeds[side].mean()) for side in (self.right, ~self.right)]
        return sum(sides) / 2.0, (sides[0] - sides[1]) / width

    def wheels(self, linear: float, angular: float, width: float) -> Array:
        """Speeds of the wheels for a twist."""
        turn = np.where(self.right, 0.5, -0.5) * angular * width
        return np.asarray((linear + turn) / self.radius)

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
            decay = math.exp(-dt / self.time_constant) if self.time_constant else 0.0
            lag = self.speeds - self.targets
            turned = self.targets * dt + lag * self.time_constant * (1.0 - decay)
            self.speeds = self.targets + lag * decay
            self.angles = self.angles + turned
            way, angle = self.body(turned, self.width)
            self.pose = moved(self.pose, way, angle)
            self.time = end
            self.past.append((end, *self.pose))

    def scan(self, times: Array, angles: Array, mount_x: float) -> Array:
        """Distance of the walls [m]: each ray at its time, its angle against the body."""
        past_times, *past = np.array(self.past).T
        x, y, theta = (np.interp(times, past_times, values) for values in past)
        x = x + mount_x * np.cos(theta)
        y = y + mount_x * np.sin(theta)
        cosine = np.cos(theta + angles)
        sine = np.sin(theta + angles)
        with np.errstate(divide="ignore"):
            to_x = np.where(cosine > 0.0, ROOM[2] - x, ROOM[0] - x) / cosine
            to_y = np.where(sine > 0.0, ROOM[3] - y, ROOM[1] - y) / sine
        return np.asarray(np.minimum(np.abs(to_x), np.abs(to_y)))


def moved(pose: tuple[float, float, float], way: float, angle: float) -> tuple[float, float, float]:
    """The pose after a short arc."""
    x, y, theta = pose
    middle = theta + angle / 2.0
    return x + way * math.cos(middle), y + way * math.sin(middle), theta + angle


def quaternion(yaw: float, *, upside_down: bool = False) -> Quaternion:
    """A turn by yaw, of what was turned by half a turn about x where it is upside down."""
    cosine = math.cos(yaw / 2.0)
    sine = math.sin(yaw / 2.0)
    return Quaternion(x=cosine, y=sine, w=0.0) if upside_down else Quaternion(z=sine, w=cosine)


class ForeignRobot:
    """The node: everything in one thread, at absolute deadlines."""

    def __init__(self, config: argparse.Namespace) -> None:
        self.config = config
        self.world = World(config)
        self.controller_width = SEPARATION * config.multiplier
        self.odometry = (0.0, 0.0, 0.0)
        self.odometry_angles = self.world.angles
        self.first_command = math.inf
        self.log = open(config.log, "w", buffering=1)  # noqa: SIM115
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
        if config.scan_rate:
            self.scan = node.create_publisher(LaserScan, "scan", sensors)
            static = "/tf_static" if config.static == "global" else "tf_static"
            self.tf_static = node.create_publisher(TFMessage, static, latched)
            if config.static != "none":
                self.tf_static.publish(TFMessage(transforms=self.mount()))
            self.periods[self.publish_scan] = 1.0 / config.scan_rate
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

    def stamp(self, now: float) -> int:
        """What the header of a message says [ns]."""
        jump = JUMP if self.begun(self.config.clock_jump_after, now) else 0.0
        return self.epoch + round((now - jump) * 1e9)

    def write(self, now: float, **values: Any) -> None:
        self.log.write(json.dumps({"monotonic": self.start + now / self.speed} | values) + "\n")

    def receive(self, message: Any) -> None:
        """Check a command as ros2_controllers do, and have it take effect after the dead time."""
        now = self.now()
        world = self.world
        refused = None
        if self.config.command == "wheel_speeds":
            command = targets = np.array(message.data)
        else:
            twist = message.twist if self.config.command == "twist_stamped" else message
            command = np.array([twist.linear.x, twist.angular.z])
            targets = world.wheels(twist.linear.x, twist.angular.z, self.controller_width)

        if self.config.command == "twist_stamped":
            stamp = Time.from_msg(message.header.stamp).nanoseconds
            age = (self.stamp(now) - stamp) * 1e-9
            if stamp and abs(age) > self.config.cmd_vel_timeout:
                refused = f"it is {age:.3f} s old"
        if len(targets) != len(world.targets):
            refused = f"{len(targets)} speeds for {len(world.targets)} wheels"
        elif not np.isfinite(targets).all():
            refused = "not finite"
        self.write(now, command=command.tolist(), **({"refused": refused} if refused else {}))
        if refused:
            return

        if any(command):
            self.first_command = min(self.first_command, now)
        # A command takes the place of the last one's time-out.
        while world.events and world.events[-1][0] > now + self.config.delay:
            world.events.pop()
        world.events.append((now + self.config.delay, targets))
        halt = now + self.config.delay + self.config.cmd_vel_timeout
        world.events.append((halt, np.zeros(len(targets))))

    def publish_clock(self, now: float) -> None:
        self.clock.publish(Clock(clock=Time(nanoseconds=self.stamp(now)).to_msg()))

    def publish_state(self, now: float) -> None:
        """joint_states, odom and its transform, and a line in the log."""
        config = self.config
        world = self.world
        stamp = self.stamp(now)
        speeds = world.speeds.tolist()
        self.write(now, speeds=speeds, pose=world.pose, stamp=stamp * 1e-9)
        way, angle = world.body(world.angles - self.odometry_angles, self.controller_width)
        self.odometry = moved(self.odometry, way, angle)
        self.odometry_angles = world.angles
        if self.begun(config.drop_after, now):
            return
        if self.begun(config.nan_after, now):
            speeds[0] = math.nan

        header = Header(stamp=Time(nanoseconds=stamp).to_msg(), frame_id="odom")
        odom = Odometry(header=header, child_frame_id=config.frame)
        x, y, theta = self.odometry
        odom.pose.pose.position.x = x
        odom.pose.pose.position.y = y
        odom.pose.pose.orientation = quaternion(theta)
        linear, angular = world.body(np.array(speeds), self.controller_width)
        odom.twist.twist.linear.x = linear
        odom.twist.twist.angular.z = angular
        self.odom.publish(odom)
        transform = TransformStamped(header=header, child_frame_id=config.frame)
        transform.transform.translation.x = x
        transform.transform.translation.y = y
        transform.transform.rotation = odom.pose.pose.orientation
        self.tf.publish(TFMessage(transforms=[transform]))
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
            if config.wrap:
                position = (position + config.wrap / 2.0) % config.wrap - config.wrap / 2.0
            states.position.append(position)
            if not config.positions_only:
                states.velocity.append(velocity)
        self.joint_states.publish(states)

    def publish_scan(self, now: float) -> None:
        """The revolution that ends now."""
        config = self.config
        count = config.scan_rays
        if self.begun(config.drop_after, now):
            return
        increment = 2.0 * math.pi / max(count, 1)
        angles = -math.pi + increment * np.arange(count)
        start = now - config.scan_time_increment * max(count - 1, 0)
        times = start + config.scan_time_increment * np.arange(count)
        towards = config.scan_yaw + (-angles if config.upside_down else angles)
        ranges = self.world.scan(times, towards, SCAN_X)

        scan = LaserScan(angle_min=-math.pi, angle_increment=increment)
        scan.header.stamp = Time(nanoseconds=self.stamp(start)).to_msg()
        scan.header.frame_id = "laser"
        scan.angle_max = scan.angle_min + increment * max(count - 1, 0)
        scan.time_increment = config.scan_time_increment
        scan.scan_time = 1.0 / config.scan_rate
        scan.range_min = 0.05
        scan.range_max = 12.0
        scan.ranges = ranges.tolist()
        self.scan.publish(scan)

    def mount(self) -> list[TransformStamped]:
        """From the base to the LiDAR, over a mast where there is one."""
        config = self.config
        hops = [(config.frame, "laser", SCAN_X, config.scan_yaw, config.upside_down)]
        if config.mast:
            hops = [(config.frame, "mast", SCAN_X, 1.5, False)]
            hops += [("mast", "laser", 0.0, config.scan_yaw - 1.5, config.upside_down)]

        transforms = []
        for parent, child, x, yaw, upside_down in hops:
            place = Transform(rotation=quaternion(yaw, upside_down=upside_down))
            place.translation.x = x
            place.translation.z = 0.1
            header = Header(frame_id=parent)
            transforms.append(
                TransformStamped(header=header, child_frame_id=child, transform=place)
            )
        return transforms

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
    config, of_ros = options()
    rclpy.init(args=[sys.argv[0], *of_ros])
    with suppress(ExternalShutdownException, KeyboardInterrupt):
        ForeignRobot(config).run()


if __name__ == "__main__":
    main()
