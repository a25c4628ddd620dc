"""Any robot behind a link as a ROS 2 node: `acsar-gym ros driver`.

The control loop runs in the main thread and knows nothing of ROS. It takes the newest command from
a `CommandInbox`, and puts what it measured into a queue. The node runs in two other threads, one
that receives and one that publishes, so that a node that stalls doesn't stall wheels.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from array import array
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from itertools import pairwise
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    LinkError,
    escape_unprintable,
    show_value,
    suggest_name,
)
from acsar_gym.guard.estop import is_held
from acsar_gym.guard.shutdown import call_at_end
from acsar_gym.lidar.laser_scan import LaserScan, make_scan
from acsar_gym.lidar.scan import Revolution
from acsar_gym.links import open_link
from acsar_gym.links.ros2 import DRIVER_NODE, SCENE_PARAMETER, START_PARAMETER
from acsar_gym.protocol import Speeds
from acsar_gym.recording import Recorder
from acsar_gym.recording.messages import make_covariances
from acsar_gym.robot import Robot
from acsar_gym.ros.node import (
    NANOSECONDS,
    SPIN_PERIOD,
    RosNode,
    explain_age,
    make_stamp,
    read_stamp,
)
from acsar_gym.ros.scenes import find_scene
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors.lidar import find_lidar
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.worlds import Scene

DIAGNOSTICS_PERIOD = 1.0
"""Time between two messages of /diagnostics [s]."""
REQUEST_TIMEOUT = 15.0
"""How long a service waits for the control loop: a reset may make a world [s]."""
QUEUE_TICKS = 1000
"""Number of ticks that wait for a node that stalls. After that, the oldest are lost."""
SIMULATION_START = NANOSECONDS
"""First time of /clock [ns]. In ROS, 0 means that a stamp isn't set."""
REPORT_PERIOD = 10.0
"""Time between two reports of the same kind of refused command [s]."""
DRIVER_PARAMETERS = (
    "name",
    "serial_port",
    "baud_rate",
    "wheel_radius",
    "wheel_separation",
    "wheelbase",
    "wheel_separation_multiplier",
    "left_wheel_radius_multiplier",
    "right_wheel_radius_multiplier",
    "control_rate",
    "max_linear",
    "max_angular",
    "max_wheel_speed",
    "feedback_timeout",
    "watchdog_timeout",
    "odom_frame",
    "base_frame",
    "lidar_frame",
    "lidar_x_offset",
    "lidar_y_offset",
    "lidar_z_offset",
)
"""Fields of a robot's file that are parameters of the node, by the same names."""
FRAME_NAME = re.compile(r"[\w./-]+")
COVARIANCES = ("pose_covariance_diagonal", "twist_covariance_diagonal")
NODE_PARAMETERS: dict[str, Any] = {
    "robot": "",
    "link": "",
    "lidar": "",
    "stamped": True,
    "publish_tf": True,
    **{name: [] for name in COVARIANCES},
    SCENE_PARAMETER: "",
    START_PARAMETER: [],
}
"""The node's other parameters, with their defaults. Only scene and start can be set later."""
ROS_PARAMETERS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
"""Prefixes of rclpy's own parameters."""


class CommandInbox:
    """Keeps the newest twist. If that can't be driven, the robot stops.

    Args:
        timeout: Time after which a twist has no effect any more [s].
        frame: Frame of the base. A twist in another frame is reported once, and driven as if it
            were in this one, as ros2_controllers do.
        report: Is called with one line about a twist, at most every 10 s for each kind.

    Attributes:
        problem: Why the newest twist was refused. Empty if it wasn't.
        simulated: Whether the ages of twists are by /clock.
    """

    def __init__(self, timeout: float, frame: str, report: Callable[[str], None]) -> None:
        self._timeout = timeout
        self._frame = frame
        self._report = report
        self._newest = (0.0, 0.0)
        self._end = -math.inf
        self._reported: dict[str, float] = {}
        self._has_reported_frame = False
        self.problem = ""
        self.simulated = False

    def take(self, velocities: Sequence[float], age: float = 0.0, frame: str = "") -> None:
        """Take a twist, or refuse it and stop.

        Args:
            velocities: Linear x, y, z [m/s] and angular x, y, z [rad/s], of which x and z count.
            age: Time since it was stamped [s].
            frame: Frame of its header.
        """
        # Nav2 and joysticks stamp their twists with other frames, and mean the base.
        if frame.lstrip("/") not in ("", self._frame) and not self._has_reported_frame:
            self._has_reported_frame = True
            self._report(f"cmd_vel: twists in {frame!r} are driven as if in {self._frame!r}")
        if not all(map(math.isfinite, velocities)):
            values = ", ".join(f"{value:g}" for value in velocities)
            self._refuse("a twist that isn't finite", values)
        elif not abs(age) < self._timeout:
            self._refuse("a twist by its stamp", f"it {explain_age(age, simulated=self.simulated)}")
        else:
            self._newest = (velocities[0], velocities[5])
            self._end = time.monotonic() + self._timeout
            self.problem = ""

    def _refuse(self, kind: str, reason: str) -> None:
        now = time.monotonic()
        self._newest = (0.0, 0.0)
        self.problem = f"cmd_vel: refused {kind} ({reason})"
        if now - self._reported.get(kind, -math.inf) >= REPORT_PERIOD:
            self._reported[kind] = now
            self._report(self.problem)

    def current(self) -> tuple[float, float]:
        """Return the twist to drive now [m/s, rad/s]. Zero if the newest one is too old."""
        return self._newest if time.monotonic() < self._end else (0.0, 0.0)


class Measured(NamedTuple):
    """What the control loop hands over after a tick."""

    stamp: int
    """Time of ROS [ns]."""
    pose: tuple[float, float, float]
    twist: tuple[float, float]
    states: list[tuple[int, Speeds, Speeds]]
    """Stamp [ns], speeds and angles of the wheels: several if several lines came in a late tick."""
    scan: LaserScan | None
    """A new scan, whose stamp is relative to this tick's [s]."""
    lateness: float
    age: float
    reason: Reason


def list_states(
    shares: Sequence[tuple[Speeds, float]], stamp: int, speeds: Speeds, angles: Speeds
) -> list[tuple[int, Speeds, Speeds]]:
    """List the joint states of a tick, so that their readers integrate the same odometry.

    Args:
        shares: Wheel speeds [rad/s] that odometry integrated, and how long each held [s].
        stamp: Time of the tick's end [ns].
        speeds: Speeds of the wheels then [rad/s].
        angles: Angles of the wheels then [rad].

    Returns:
        Stamps [ns], speeds and angles, the oldest first.
    """
    states = [(stamp, speeds, angles)]

    # A late tick integrates several lines. Go back from its end, line by line.
    for (earlier, _), (later, share) in reversed([*pairwise(shares)]):
        stamp -= round(share * NANOSECONDS)
        a, b, c, d = (angle - speed * share for angle, speed in zip(angles, later, strict=True))
        angles = (a, b, c, d)
        states.insert(0, (stamp, earlier, angles))
    return states


class RobotNode(RosNode):
    """The node of a robot: topics, services and parameters.

    Args:
        options: "robot", "link", "lidar" and "scene", which have precedence over the parameters of
            these names. Empty ones have not.
        namespace: Namespace of the node.
        arguments: Arguments of ROS, which follow "--ros-args".

    Attributes:
        config: Robot configuration, with the values of the node's parameters.
        inbox: The commands.
        requests: What services ask of the control loop, each with the future of its answer.
        link: Link by the node's parameters.
        lidar: LiDAR by the node's parameters.

    Raises:
        MissingRosError: ROS 2 isn't installed.
        RosSetupError: ROS refuses the arguments.
        ConfigError: A parameter has a wrong value.
    """

    def __init__(
        self,
        options: Mapping[str, str | None],
        namespace: str = "",
        arguments: Sequence[str] = (),
    ) -> None:
        overrides: dict[str, Any] = {name: value for name, value in options.items() if value}
        overrides["use_sim_time"] = False  # it publishes /clock itself, or there is none
        super().__init__(DRIVER_NODE, namespace, arguments, overrides=overrides, services=True)

        self.requests: deque[tuple[Callable[[], str], Future[str]]] = deque()
        self._measured: SimpleQueue[Measured] = SimpleQueue()
        self._newest_stamp = SIMULATION_START
        self._due = 0.0
        self._ticks = 0
        self._late_ticks = 0
        self._reported_late_ticks = 0
        self._lateness = 0.0
        self._reported: set[str] = set()

        try:
            self._read_parameters()
            self._make_topics()
        except BaseException:
            super().close()
            raise

    def _read_parameters(self) -> None:
        """Declare the parameters, and read their values."""
        # The robot's file gives the defaults of its fields, so it is read first.
        # Before others are declared: only these were given by the user.
        given_names = self.list_parameters()
        self.declare(NODE_PARAMETERS, changeable=(SCENE_PARAMETER, START_PARAMETER))
        config = RobotConfig.of(self._read("robot", str) or None)
        fields = {name: getattr(config, name) for name in DRIVER_PARAMETERS}
        defaults = {name: "" if value is None else value for name, value in fields.items()}
        self.declare(defaults | {"cmd_vel_timeout": config.firmware.command_timeout or 0.5})
        for name in given_names:
            # A mistyped parameter would have no effect without a notice.
            names = {*defaults, *NODE_PARAMETERS, "cmd_vel_timeout"}
            if name not in names and not name.startswith(ROS_PARAMETERS):
                self.warn(f"parameter {name}: doesn't exist{suggest_name(name, names)}")

        # Only values that differ from the robot's file change it.
        values = {name: self.read_parameter(name) for name in defaults}
        changes = {name: value for name, value in values.items() if value != defaults[name]}
        self.config = config.with_(**changes)
        self._check_frames()
        if self.config.twist_geometry != (
            *self.config.wheel_radii,
            self.config.effective_separation,
        ):
            self.warn(
                "wheel_separation or wheel_radii of ros2 in the robot's file are another "
                "controller's: this node converts twists by those of the robot"
            )
        self.link = self._read("link", str)
        self.lidar = self._read("lidar", str)
        # 1 is an integer in YAML.
        timeout = self._read("cmd_vel_timeout", int, float)
        if not 0.0 < timeout < math.inf:
            raise ConfigError(f"cmd_vel_timeout = {timeout:g}: must be positive")
        self.inbox = CommandInbox(timeout, self.config.base_frame, self.warn)

    def _check_frames(self) -> None:
        """Raise ConfigError unless the frames have three different names, as a tree of tf needs."""
        config = self.config
        frames = (config.odom_frame, config.base_frame, config.lidar_frame)
        if len(set(frames)) < len(frames) or not all(map(FRAME_NAME.fullmatch, frames)):
            raise ConfigError(
                f"odom_frame, base_frame, lidar_frame = {', '.join(map(show_value, frames))}: must "
                "be three different names"
            )

    def _read(self, name: str, *kinds: type) -> Any:
        """Return the value of a parameter. ConfigError if it has another type."""
        value = self.read_parameter(name)
        if type(value) not in kinds:
            raise ConfigError(f"{name} = {show_value(value)}: must be of type {kinds[-1].__name__}")
        return value

    def _read_numbers(self, name: str) -> list[float]:
        """Return the numbers of a parameter. ConfigError for anything else."""
        values = [*self._read(name, array, list)]
        if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
            raise ConfigError(f"{name} = {show_value(values)}: must be finite numbers")
        return values

    def _read_diagonal(self, name: str) -> list[float] | None:
        """Return the six variances of a parameter. None if it is empty."""
        values = self._read_numbers(name)
        if len(values) not in (0, 6) or min(values, default=0.0) < 0.0:
            raise ConfigError(f"{name} = {show_value(values)}: must be six variances")
        return values or None

    def _make_topics(self) -> None:
        """Make publishers and the subscription, and messages that are filled again and again."""
        ros = self.ros
        config = self.config

        # A topic has one type, or rosbag2 and `ros2 topic echo` refuse it.
        if self._read("stamped", bool):
            self.subscribe("cmd_vel", ros.TwistStamped, self._take_stamped, 10)
        else:
            self.subscribe("cmd_vel", ros.Twist, self._take_twist, 10)

        self._joints = self.publish("joint_states", ros.JointState, depth=10)
        self._state = ros.JointState(name=list(config.ros_joints))
        self._odometry = self.publish("odom", ros.Odometry, depth=10)
        self._odom = ros.Odometry(child_frame_id=config.base_frame)
        self._odom.header.frame_id = config.odom_frame

        # Live messages have the covariances of recordings.
        covariances = make_covariances(*map(self._read_diagonal, COVARIANCES))
        self._odom.pose.covariance, self._odom.twist.covariance = covariances
        self._scans = self.publish("scan", ros.LaserScan, depth=5)
        self._scan = ros.LaserScan()
        self._scan.header.frame_id = config.lidar_frame
        self._diagnostics = self.publish("/diagnostics", ros.DiagnosticArray, depth=10)
        self._clock: Any = None
        self._tf: Any = None
        publishes_tf = self._read("publish_tf", bool)
        if ros.TFMessage is None:
            self.warn("tf2_msgs isn't installed: no /tf and /tf_static are published")
            return

        # The LiDAR doesn't move on the robot: a latched transform is enough.
        mount = ros.TransformStamped(child_frame_id=config.lidar_frame)
        mount.header.frame_id = config.base_frame
        place = mount.transform.translation
        place.x = config.lidar_x_offset
        place.y = config.lidar_y_offset
        place.z = config.lidar_z_offset
        self._static = self.publish("/tf_static", ros.TFMessage, latched=True)
        self._static.publish(ros.TFMessage(transforms=[mount]))
        if publishes_tf:
            self._tf = self.publish("/tf", ros.TFMessage, depth=100)
            self._transform = ros.TransformStamped(child_frame_id=config.base_frame)
            self._transform.header.frame_id = config.odom_frame

    # For the control loop

    def offer(self, services: dict[str, Callable[[], str]]) -> None:
        """Offer services of type std_srvs/Trigger, whose work the control loop does."""

        def serve(work: Callable[[], str], _: Any, response: Any) -> Any:
            # The loop may be in the middle of a tick, so the answer comes later.
            answer: Future[str] = Future()
            self.requests.append((work, answer))
            try:
                response.message = answer.result(REQUEST_TIMEOUT)
                response.success = True
            except TimeoutError:
                response.message = "the control loop doesn't answer"
            except AcsarError as error:
                response.message = escape_unprintable(str(error))
            return response

        for name, work in services.items():
            kind = self.ros.Trigger
            self.node.create_service(kind, f"~/{name}", partial(serve, work))

    def start_clock(self) -> None:
        """Publish /clock from now on: time is simulated."""
        self._clock = self.publish("/clock", self.ros.Clock)
        self.inbox.simulated = True

    def start(self) -> None:
        """Start the threads, which end before the process does."""
        call_at_end(self.close)
        # A callback that blocks must not delay what is published, nor the reverse.
        self.start_threads(partial(self.spin, SPIN_PERIOD), self._publish_measured)
        self.say(f"drives {self.link or self.config.serial_port}")

    def read_scene(self) -> Scene:
        """Return the scene of the node's parameters. ConfigError if there is no such scene."""
        name = str(self.read_parameter(SCENE_PARAMETER))
        return find_scene(name, self._read_numbers(START_PARAMETER), self.config)

    def put(self, measured: Measured) -> None:
        """Hand over what was measured in a tick. Doesn't wait."""
        self._measured.put(measured)

        # A node that stalls for long loses the oldest ticks, and not memory.
        if self._measured.qsize() > QUEUE_TICKS:
            with contextlib.suppress(Empty):
                self._measured.get_nowait()

    def close(self) -> None:
        """End threads and node."""
        while self.requests:
            _, answer = self.requests.popleft()
            answer.set_exception(ConfigError("the driver has ended"))
        super().close()

    # In the threads

    def _take_stamped(self, message: Any) -> None:
        # A stamp of zero means now, as in ros2_controllers.
        stamp = read_stamp(message.header.stamp)
        now = self._newest_stamp if self._clock is not None else self.now()
        age = (now - stamp) / NANOSECONDS if stamp else 0.0
        self._take_twist(message.twist, age, message.header.frame_id)

    def _take_twist(self, message: Any, age: float = 0.0, frame: str = "") -> None:
        # All six components must be finite, though a robot drives only two.
        vectors = (message.linear, message.angular)
        velocities = [number for vector in vectors for number in (vector.x, vector.y, vector.z)]
        self.inbox.take(velocities, age, frame)

    def _publish_measured(self) -> None:
        """Publish what the control loop hands over, if it does so soon."""
        try:
            measured = self._measured.get(timeout=SPIN_PERIOD)
        except Empty:
            return

        # Wheels first, so that a reader has them before the pose that they give.
        for nanoseconds, speeds, angles in measured.states:
            self._state.header.stamp = make_stamp(self.ros, nanoseconds)
            self._state.position = angles
            self._state.velocity = speeds
            self._joints.publish(self._state)

        stamp = make_stamp(self.ros, measured.stamp)
        self._publish_pose(measured, stamp)
        if measured.scan is not None:
            self._publish_scan(measured.stamp, measured.scan)
        self._newest_stamp = measured.stamp
        if self._clock is not None:
            self._clock.publish(self.ros.Clock(clock=stamp))

        # Counted here, so that the control loop doesn't share numbers with this thread.
        self._ticks += 1
        self._late_ticks += measured.lateness > self.config.late_tick
        self._lateness = max(self._lateness, measured.lateness)
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + DIAGNOSTICS_PERIOD
            self._publish_diagnostics(measured, stamp)

    def _publish_pose(self, measured: Measured, stamp: Any) -> None:
        x, y, theta = measured.pose
        linear, angular = measured.twist
        odom = self._odom
        odom.header.stamp = stamp
        pose = odom.pose.pose
        pose.position.x = x
        pose.position.y = y
        pose.orientation.z = math.sin(theta / 2.0)
        pose.orientation.w = math.cos(theta / 2.0)
        odom.twist.twist.linear.x = linear
        odom.twist.twist.angular.z = angular
        self._odometry.publish(odom)

        if self._tf is not None:
            self._transform.header.stamp = stamp
            place = self._transform.transform
            place.translation.x = x
            place.translation.y = y
            place.rotation = pose.orientation
            self._tf.publish(self.ros.TFMessage(transforms=[self._transform]))

    def _publish_scan(self, stamp: int, scan: LaserScan) -> None:
        message = self._scan

        # A scan is stamped with the time of its first ray.
        first_ray = max(stamp + round(scan.stamp * NANOSECONDS), 0)
        message.header.stamp = make_stamp(self.ros, first_ray)
        for name in (
            *("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time"),
            *("range_min", "range_max", "ranges"),
        ):
            setattr(message, name, getattr(scan, name))
        self._scans.publish(message)

    def _publish_diagnostics(self, measured: Measured, stamp: Any) -> None:
        ros = self.ros
        kinds = ros.DiagnosticStatus
        reason = measured.reason
        problem = self.inbox.problem or self._check_publishers()
        status = kinds(level=kinds.OK, message="drives", hardware_id=self.link)
        status.name = f"{DRIVER_NODE}: link"

        # The worst problem is the level of the message.
        if problem or self._late_ticks > self._reported_late_ticks:
            status.level = kinds.WARN
            status.message = problem or "the control loop is late"
        if reason in (Reason.EMERGENCY_STOP, Reason.GEOFENCE, Reason.STALE_FEEDBACK):
            status.level = kinds.ERROR
            status.message = reason.name.lower().replace("_", " ")

        values = {
            "emergency stop": str(reason is Reason.EMERGENCY_STOP).lower(),
            "why the sent twist isn't the commanded one": reason.name.lower(),
            "age of the feedback [s]": f"{measured.age:.4f}",
            "latest tick [s]": f"{self._lateness:.6f}",
            "late ticks": f"{self._late_ticks} of {self._ticks}",
            "commands": problem or "taken",
        }
        self._reported_late_ticks = self._late_ticks
        self._lateness = 0.0
        status.values = [ros.KeyValue(key=key, value=value) for key, value in values.items()]
        array = ros.DiagnosticArray(status=[status])
        array.header.stamp = stamp
        self._diagnostics.publish(array)

    def _check_publishers(self) -> str:
        """Return what is wrong with the publishers of commands, and report it once."""
        problem = ""
        commanders = sorted(self.list_commanders("cmd_vel"))
        if len(commanders) > 1:
            problem = (
                f"cmd_vel: {len(commanders)} publishers ({', '.join(commanders)}): the newest "
                "command is driven: end the others, or let a twist_mux choose"
            )
        elif self.problem:
            problem = f"{self.problem}: publishers must be reliable and volatile"
        if problem and problem not in self._reported:
            self._reported.add(problem)
            self.warn(problem)
        return problem


class DrivenRobot:
    """The control loop: a robot that drives what its node receives.

    Args:
        node: Node of the robot.
        speed: How fast simulated time passes, 1.0 for real time.
        recorder: Records what the robot does.
    """

    def __init__(
        self, node: RobotNode, speed: float = 1.0, recorder: Recorder | None = None
    ) -> None:
        self._node = node
        link = open_link(node.link or "serial", node.config, realtime=speed)

        # A second node for the same robot would command it as well.
        if link.ros is not None:
            raise ConfigError(f"link = {show_value(node.link)}: that robot is in ROS already")
        self._simulated = link.lateness is None

        has_lidar = node.lidar or self._simulated
        sensors = sensor_factories(["lidar"], node.lidar or None) if has_lidar else ()
        self._robot = Robot(link, node.config, sensors, recorder)
        self._scanned = -math.inf
        self._turn: tuple[float, int] | None = None
        self._offset = SIMULATION_START
        self._newest_stamp = SIMULATION_START
        self._is_held = False

        services = {
            "estop": self._estop,
            "release": self._release,
            "reset_odometry": self._reset_odometry,
        }
        if self._simulated:
            services["reset"] = self._reset
            node.start_clock()
        node.offer(services)

    def run(self) -> None:
        """Drive until an error or an interrupt. Stops and closes on every exit path."""
        robot = self._robot
        node = self._node
        try:
            self._begin(node.read_scene())
            node.start()

            while True:
                node.check()
                while node.requests:
                    self._answer(*node.requests.popleft())
                robot.drive(*node.inbox.current())
                node.put(self._measure())
                # An emergency stop of another process holds until it is released there.
                is_stopped = robot.safety.reason is Reason.EMERGENCY_STOP
                if is_stopped and not (self._is_held or is_held()):
                    robot.safety.reset()  # released from another terminal
        finally:
            robot.close()
            node.close()

    def _answer(self, work: Callable[[], str], answer: Future[str]) -> None:
        """Do the work of a service. Its error is the answer."""
        try:
            answer.set_result(work())
        except AcsarError as error:
            answer.set_exception(error)
            if not isinstance(error, ConfigError | LinkError):
                raise

        # A failed reset leaves the robot inactive, but the loop goes on.
        if not self._robot.active:
            self._begin(Scene())

    def _begin(self, scene: Scene) -> None:
        """Reset the robot. Stamps go on growing."""
        self._robot.reset(scene)

        # Simulated time starts again at zero with a reset, but the time of ROS must not.
        start = self._newest_stamp if self._simulated else self._node.now()
        self._offset = start - round(self._robot.link.now() * NANOSECONDS)
        self._scanned = -math.inf

    def _measure(self) -> Measured:
        """Return what was measured in the newest tick."""
        robot = self._robot
        odometry = robot.odometry
        angles = odometry.wheel_positions
        self._newest_stamp = stamp = self._offset + round(robot.wire.stamp * NANOSECONDS)
        return Measured(
            stamp=stamp,
            pose=odometry.pose,
            twist=odometry.twist,
            states=list_states(robot.shares, stamp, speeds=robot.speeds, angles=angles),
            scan=self._take_scan(),
            lateness=robot.link.lateness or 0.0,
            age=robot.feedback_age,
            reason=robot.safety.reason,
        )

    def _take_scan(self) -> LaserScan | None:
        """Return the newest revolution as a message, if it is new."""
        # A LiDAR turns more slowly than the loop ticks.
        sensor = find_lidar(self._robot.sensors)
        if sensor is None or sensor.revolution.stamp <= self._scanned:
            return None
        bearings, distances, times, self._scanned = sensor.revolution

        # The message has its own stamp, to which the times of the rays are relative.
        relative = Revolution(bearings, distances, times - self._robot.wire.stamp, 0.0)
        lidar = self._node.config.lidar
        angle_min, rays = self._turn or (None, None)
        scan = make_scan(relative, lidar.min_range, lidar.max_range, angle_min=angle_min, rays=rays)
        if self._turn is None:  # mapping programs expect the same rays in each scan
            self._turn = (scan.angle_min, np.size(scan.ranges))
        return scan

    # Services

    def _estop(self) -> str:
        # Without this mark, the loop would release the stop at once.
        self._is_held = True
        self._robot.estop()
        return "stopped; call release to drive again"

    def _release(self) -> str:
        self._is_held = False
        self._robot.release_estop()
        self._robot.safety.reset()
        return "released"

    def _reset_odometry(self) -> str:
        self._robot.odometry.reset()
        return "the robot is at the origin of its odometry"

    def _reset(self) -> str:
        self._begin(self._node.read_scene())
        return "the robot is in the scene"
