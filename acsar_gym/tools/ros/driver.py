"""A robot behind any link as a robot of ROS 2: `acsar-gym ros driver`.

The control loop runs in the main thread and knows nothing of ROS: it takes the newest command from
a `CommandInbox`, and puts what it measured into a queue. Nodes spin in threads of their own, so
that one that stalls doesn't stall wheels.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import re
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    LinkError,
    WorldError,
    escape_unprintable,
    show_value,
    suggest_name,
)
from acsar_gym.guard.estop import is_held
from acsar_gym.guard.shutdown import call_at_end
from acsar_gym.lidar.laser_scan import LaserScan, make_scan
from acsar_gym.lidar.scan import Revolution
from acsar_gym.links import open_link
from acsar_gym.links.ros2 import DRIVER_NODE, SCENE_PARAMETER
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE
from acsar_gym.protocol import Speeds
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.ros.node import NANOSECONDS, RosNode, RosSetupError, make_stamp, read_stamp
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors.lidar import find_lidar
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.worlds import Scene
from acsar_gym.worlds.files import load_world
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, lidar_height

DIAGNOSTICS_PERIOD = 1.0
"""Time between two messages of /diagnostics [s]."""
REQUEST_TIMEOUT = 15.0
"""How long a service waits for the control loop, as a reset builds a world [s]."""
QUEUE_TICKS = 1000
"""How many ticks wait for a node that stalls; then the oldest are lost."""
SIMULATION_START = NANOSECONDS
"""Time of /clock at which a simulation begins [ns]; 0 means that a stamp isn't set."""
SPIN_PERIOD = 0.1
"""How soon threads notice that they must end [s]."""
OTHER_PUBLISHER_STEP = 1000
"""Sequence numbers of one publisher's messages don't jump farther."""
LEAST_DELAY_PERIOD = 5.0
"""The least delay of messages is that of the last one to two such times [s]."""
REPORT_PERIOD = 10.0
"""Time between two reports of the same kind of bad command [s]."""
FRAME_NAME = re.compile(r"[\w./-]+")
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
"""Fields of a robot that are parameters of the node, by the same names."""
NODE_PARAMETERS = ("robot", "link", "lidar", "cmd_vel_timeout", "publish_tf", SCENE_PARAMETER)
"""The node's other parameters."""
ROS_PARAMETERS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
"""What rclpy's own parameters begin with."""


class Command(NamedTuple):
    """A twist, as the control loop takes it."""

    linear: float
    angular: float
    when: float
    """When it arrived, on the clock of `time.monotonic` [s]."""


STANDING = Command(0.0, 0.0, -math.inf)


class CommandInbox:
    """Keeps the newest twist, and refuses what must not be driven: the robot stands then.

    Args:
        timeout: after which a twist doesn't count any more [s].
        frame: of the base; stamped twists in others are refused.
        report: is called with one line for what is refused; a kind of it at most every 10 s.

    Attributes: `problem`, what is wrong with the newest twist; empty where nothing is.
    """

    def __init__(self, timeout: float, frame: str, report: Callable[[str], None]) -> None:
        self._timeout = timeout
        self._frame = frame
        self._report = report
        self._newest = STANDING
        self._driving: dict[object, float] = {}
        self._reported: dict[str, float] = {}
        self._lock = threading.Lock()  # two nodes take; the control loop never waits
        self.problem = ""

    def take(
        self, velocities: Sequence[float], source: object, age: float = 0.0, frame: str = ""
    ) -> None:
        """Take a twist; or refuse it, and stand.

        Twists of two publishers that both drive are refused; zeros of any are taken.

        Args:
            velocities: linear x, y, z [m/s] and angular x, y, z [rad/s], of which x and z count.
            source: tells publishers apart.
            age: since it was sent [s].
            frame: of its header.
        """
        with self._lock:
            self._take(velocities, source, age, frame)

    def _take(self, velocities: Sequence[float], source: object, age: float, frame: str) -> None:
        now, timeout = time.monotonic(), self._timeout
        linear, angular = velocities[0], velocities[5]
        if not all(map(math.isfinite, velocities)):
            values = ", ".join(f"{value:g}" for value in velocities)
            self._refuse(now, "a twist that isn't finite", values)
        elif frame.lstrip("/") not in ("", self._frame):
            self._refuse(now, "a twist in another frame", f"{frame!r}, not {self._frame!r}")
        elif not -timeout < age < timeout:
            when = f"{abs(age):.2f} s {'old' if age > 0.0 else 'ahead'}"
            self._refuse(now, "a twist by its stamp", f"{when}; do the clocks agree?")
        elif not (linear or angular):
            self._driving.pop(source, None)
            self._newest, self.problem = Command(0.0, 0.0, now), ""
        else:
            self._driving[source] = now
            self._driving = {
                driver: when for driver, when in self._driving.items() if now - when < timeout
            }
            if len(self._driving) > 1:
                self._refuse(now, "the twists of two publishers", "end one, or use a twist_mux")
                return
            self._newest, self.problem = Command(linear, angular, now), ""

    def _refuse(self, now: float, what: str, why: str) -> None:
        self._newest = STANDING
        self.problem = f"cmd_vel: refused {what} ({why})"
        if now - self._reported.get(what, -math.inf) >= REPORT_PERIOD:
            self._reported[what] = now
            self._report(self.problem)

    def current(self) -> tuple[float, float]:
        """Return the twist to drive now [m/s, rad/s]; zero where none is new enough."""
        newest = self._newest
        if time.monotonic() - newest.when > self._timeout:
            return 0.0, 0.0
        return newest.linear, newest.angular


class PublisherNumbers:
    """Tells publishers apart by sequence numbers, which grow for each of them alone.

    For middleware that names no publisher, as before Kilted.

    Args:
        timeout: after which a publisher is forgotten [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._newest: dict[int, tuple[int, float]] = {}
        self._count = itertools.count()

    def find(self, sequence: int) -> int:
        """Return a number of the publisher of a message that has just arrived."""
        now = time.monotonic()
        steps = {
            publisher: sequence - last
            for publisher, (last, when) in self._newest.items()
            if now - when < self._timeout and 0 < sequence - last < OTHER_PUBLISHER_STEP
        }
        publisher = min(steps, key=steps.__getitem__) if steps else next(self._count)
        self._newest[publisher] = sequence, now
        return publisher


class LatenessMeter:
    """Tells how late messages are, by when they were sent: those of a middleware that hung are old.

    The clocks of two computers may differ, so that the least delay of the last seconds is none.
    """

    def __init__(self) -> None:
        self._delays: dict[object, tuple[int, int, int]] = {}

    def find(self, publisher: object, sent: int, now: int) -> float:
        """Return how much later a message came than others of its publisher [s]; times in [ns]."""
        delay = now - sent
        begin, before, least = self._delays.get(publisher, (now, delay, delay))
        if now - begin > LEAST_DELAY_PERIOD * NANOSECONDS:
            begin, before, least = now, least, delay
        least = min(least, delay)
        self._delays[publisher] = begin, before, least
        return (delay - min(before, least)) / NANOSECONDS


class Measured(NamedTuple):
    """What the control loop hands over after a tick."""

    stamp: int
    """Of ROS's clock [ns]."""
    pose: tuple[float, float, float]
    twist: tuple[float, float]
    speeds: Speeds
    angles: Speeds
    scan: LaserScan | None
    """A new one, whose stamp is relative to this tick's [s]."""
    lateness: float | None
    age: float
    reason: Reason
    earlier: list[tuple[int, Speeds, Speeds]]
    """Stamps, speeds and angles before the newest, of a late tick in which several lines came."""


@dataclass
class Request:
    """What a service asks of the control loop, and its answer."""

    work: Callable[[], str]
    done: threading.Event = field(default_factory=threading.Event)
    answer: str = ""
    failed: bool = True

    def run(self) -> None:
        """Do the work, in the control loop."""
        try:
            self.answer, self.failed = self.work(), False
        except AcsarError as error:
            self.answer = escape_unprintable(str(error))
            raise
        finally:
            self.done.set()


class RobotNode:
    """The node of a robot: topics, services and parameters, in threads of their own.

    Attributes: `config`, of the robot, with the values of the node's parameters; `inbox`, the
    commands; `requests`, what services ask for; `link` and `lidar`, by the node's parameters.

    Args:
        given: "robot", "link", "lidar" and "scene", which count more than the node's parameters of
            these names; None and "" leave them as they are.
        namespace: of the node.
        arguments: ROS's own, after "--ros-args".

    Raises:
        MissingRosError: ROS 2 isn't installed.
        RosSetupError: ROS refuses the arguments.
        ConfigError: a parameter can't be used.
    """

    def __init__(
        self,
        given: Mapping[str, str | None],
        namespace: str = "",
        arguments: Sequence[str] = (),
    ) -> None:
        overrides: dict[str, Any] = {name: value for name, value in given.items() if value}
        overrides["use_sim_time"] = False  # the robot's own: it publishes /clock, or there is none
        self._node = node = RosNode(
            DRIVER_NODE, namespace, arguments, overrides=overrides, services=True
        )
        self._ros = ros = node.ros
        try:
            given_names = node.list_parameters()
            self.config = config = self._read_config()
            if config.twist_geometry != (*config.wheel_radii, config.effective_separation):
                self.warn(
                    "wheel_separation or wheel_radii of ros2 in the robot's file are another "
                    "controller's: this one takes twists by those of the robot"
                )
            self.link, self.lidar = self._read("link", str), self._read("lidar", str)
            publishes_tf = self._read("publish_tf", bool)
            timeout = self._read_timeout()
            self.inbox = CommandInbox(timeout, config.base_frame, self.warn)
            self._numbers = PublisherNumbers(timeout)
            self._delays = LatenessMeter()
            self.requests: deque[Request] = deque()
            self._measured: SimpleQueue[Measured] = SimpleQueue()
            self._make_messages()
            # One participant can't have a topic of two types.
            self._unstamped = RosNode(f"{DRIVER_NODE}_twist", node.namespace, _remaps(arguments))
        except BaseException:
            node.close()
            raise
        known = {*DRIVER_PARAMETERS, *NODE_PARAMETERS}
        for name in given_names:
            if name not in known and not name.startswith(ROS_PARAMETERS):
                self.warn(f"parameter {name}: there is none{suggest_name(name, known)}")
        topic = "cmd_vel"
        node.subscribe(topic, ros.TwistStamped, self._take_stamped, 10)
        self._unstamped.subscribe(topic, ros.Twist, self._take_twist, 10)
        self._joints = node.publish("joint_states", ros.JointState, depth=10)
        self._odometry = node.publish("odom", ros.Odometry, depth=10)
        self._scan = node.publish("scan", ros.LaserScan, depth=5)
        self._diagnostics = node.publish("/diagnostics", ros.DiagnosticArray, depth=10)
        self._clock: Any = None
        self._tf: Any = None
        if ros.TFMessage is not None and publishes_tf:
            self._tf = node.publish("/tf", ros.TFMessage, depth=100)
        self._publish_static()
        self._due = 0.0
        self._lateness = 0.0
        self._ticks = self._late_ticks = 0
        self._running = True
        self._failure: Exception | None = None
        self._threads = [
            threading.Thread(target=self._repeat, args=(work,), daemon=True)
            for work in (
                self._publish_measured,
                partial(node.spin, SPIN_PERIOD),
                partial(self._unstamped.spin, SPIN_PERIOD),
            )
        ]

    def _read_config(self) -> RobotConfig:
        """Declare the parameters, and return the robot with their values."""
        node = self._node
        node.declare(dict.fromkeys(("robot", "link", "lidar"), ""))
        config = RobotConfig.of(self._read("robot", str) or None)
        fields = {name: getattr(config, name) for name in DRIVER_PARAMETERS}
        fields = {name: "" if value is None else value for name, value in fields.items()}
        timeout = config.firmware.command_timeout or 0.5
        node.declare(fields | {"publish_tf": True, "cmd_vel_timeout": timeout})
        node.declare({SCENE_PARAMETER: ""}, fixed=False)
        node.node.add_on_set_parameters_callback(self._check_scene)
        values = {name: node.read_parameter(name) for name in fields}
        config = config.with_(
            **{name: values[name] for name in fields if values[name] != fields[name]}
        )
        frames = [config.odom_frame, config.base_frame, config.lidar_frame]
        if len({*frames}) < len(frames) or not all(map(FRAME_NAME.fullmatch, frames)):
            raise ConfigError(
                f"odom_frame, base_frame, lidar_frame = {', '.join(map(repr, frames))}: must be "
                "three different names"
            )
        return config

    def _read(self, name: str, *kinds: type) -> Any:
        """Return the value of a parameter; ConfigError where it is of no such type."""
        value = self._node.read_parameter(name)
        if type(value) not in kinds:
            raise ConfigError(f"{name} = {show_value(value)}: must be of type {kinds[-1].__name__}")
        return value

    def _read_timeout(self) -> float:
        """Return after how long a twist doesn't count any more [s]."""
        timeout = float(self._read("cmd_vel_timeout", int, float))
        if not 0.0 < timeout < math.inf:
            raise ConfigError(f"cmd_vel_timeout = {timeout:g}: must be positive")
        return timeout

    def _make_messages(self) -> None:
        """Make the messages that are filled and published again and again."""
        ros, config = self._ros, self.config
        self._state = ros.JointState(name=list(config.ros_joints))
        self._moved = ros.Odometry(child_frame_id=config.base_frame)
        self._moved.header.frame_id = config.odom_frame
        self._moved.pose.covariance = POSE_COVARIANCE
        self._moved.twist.covariance = TWIST_COVARIANCE
        self._seen = ros.LaserScan()
        self._seen.header.frame_id = config.lidar_frame
        self._transform = ros.TransformStamped(child_frame_id=config.base_frame)
        self._transform.header.frame_id = config.odom_frame

    def _publish_static(self) -> None:
        """Publish where the LiDAR sits."""
        ros, config = self._ros, self.config
        if ros.TFMessage is None:
            self.warn("tf2_msgs isn't installed: no /tf and /tf_static are published")
            return
        mount = ros.TransformStamped(child_frame_id=config.lidar_frame)
        mount.header.frame_id = config.base_frame
        place = mount.transform.translation
        place.x, place.y = config.lidar_x_offset, config.lidar_y_offset
        place.z = config.lidar_z_offset
        self._static = self._node.publish("/tf_static", ros.TFMessage, latched=True)
        self._static.publish(ros.TFMessage(transforms=[mount]))

    def warn(self, text: str) -> None:
        """Log a line."""
        self._node.node.get_logger().warning(escape_unprintable(text))

    def say(self, text: str) -> None:
        """Log a line about what goes well."""
        self._node.node.get_logger().info(escape_unprintable(text))

    def offer(self, services: dict[str, Callable[[], str]]) -> None:
        """Offer services of type std_srvs/Trigger, whose work the control loop does."""
        for name, work in services.items():
            self._node.node.create_service(self._ros.Trigger, f"~/{name}", self._make_service(work))

    def _make_service(self, work: Callable[[], str]) -> Callable[[Any, Any], Any]:
        def serve(_: Any, response: Any) -> Any:
            request = Request(work)
            self.requests.append(request)
            if not request.done.wait(REQUEST_TIMEOUT):
                request.answer = "the control loop doesn't answer"
            response.success, response.message = not request.failed, request.answer
            return response

        return serve

    def start_clock(self) -> None:
        """Publish /clock from now on: time is simulated."""
        self._clock = self._node.publish("/clock", self._ros.Clock)

    def start(self) -> None:
        """Start the threads, which end before the process does."""
        call_at_end(self.close)
        for thread in self._threads:
            thread.start()

    def now(self) -> int:
        """Return the time of the node's clock [ns]."""
        return self._node.now()

    def read_scene(self) -> Scene:
        """Return the scene that the node's parameter names. ConfigError where it can't be used."""
        return self._make_scene(str(self._node.read_parameter(SCENE_PARAMETER)))

    def _check_scene(self, parameters: Sequence[Any]) -> Any:
        """Refuse a scene that can't be used, when somebody sets it."""
        result = self._ros.SetParametersResult(successful=True)
        for parameter in parameters:
            if parameter.name == SCENE_PARAMETER:
                try:
                    self._make_scene(str(parameter.value))
                except AcsarError as error:
                    result.successful, result.reason = False, escape_unprintable(str(error))
        return result

    def _make_scene(self, scene: str) -> Scene:
        scene = scene.strip()
        is_named = scene and not scene.startswith("{")
        return find_scene(scene, self.config) if is_named else parse_scene(scene)

    def put(self, measured: Measured) -> None:
        """Hand over what was measured in a tick; doesn't wait."""
        self._measured.put(measured)
        if self._measured.qsize() > QUEUE_TICKS:
            with contextlib.suppress(Empty):
                self._measured.get_nowait()

    def check(self) -> None:
        """Raise RosSetupError where a thread has failed."""
        if self._failure is not None:
            raise RosSetupError(DRIVER_NODE, self._node.namespace, self._failure) from self._failure

    def _repeat(self, work: Callable[[], None]) -> None:
        try:
            while self._running:
                work()
        except Exception as error:  # noqa: BLE001 - whatever it is ends the control loop
            self._failure = error

    def _take_stamped(self, message: Any, info: Any) -> None:
        stamp = read_stamp(message.header.stamp)
        age = (self._ros_time() - stamp) / NANOSECONDS if stamp else 0.0
        self._take_twist(message.twist, info, age, message.header.frame_id)

    def _take_twist(self, message: Any, info: Any, age: float = 0.0, frame: str = "") -> None:
        linear, angular = message.linear, message.angular
        velocities = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
        publisher, sent = self._find_publisher(info), info.get("source_timestamp")
        if sent:
            late = self._delays.find(publisher, sent, time.time_ns())
            age = max(age, late) if age >= 0.0 else age
        self.inbox.take(velocities, publisher, age, frame)

    def _find_publisher(self, info: Any) -> object:
        """Return what tells publishers apart."""
        gid, sequence = info.get("publisher_gid"), info.get("publication_sequence_number")
        if gid is not None:
            return gid["data"]
        return 0 if sequence is None else self._numbers.find(sequence)

    def _ros_time(self) -> int:
        """Return the time of what is published [ns]."""
        if self._clock is None:
            return self._node.now()
        return self._newest

    _newest = SIMULATION_START

    def _publish_measured(self) -> None:
        """Publish what the control loop hands over, if it does so soon."""
        try:
            measured = self._measured.get(timeout=SPIN_PERIOD)
        except Empty:
            return
        stamp = make_stamp(self._ros, measured.stamp)
        state = self._state
        for before, speeds, angles in measured.earlier:
            state.header.stamp = make_stamp(self._ros, before)
            state.position, state.velocity = angles, speeds
            self._joints.publish(state)
        state.header.stamp = stamp
        state.position, state.velocity = measured.angles, measured.speeds
        self._joints.publish(state)
        self._publish_pose(measured, stamp)
        if measured.scan is not None:
            self._publish_scan(measured, measured.scan)
        self._newest = measured.stamp
        if self._clock is not None:
            self._clock.publish(self._ros.Clock(clock=stamp))
        self._lateness = max(self._lateness, measured.lateness or 0.0)
        self._ticks += 1
        self._late_ticks += (measured.lateness or 0.0) > self.config.late_tick
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + DIAGNOSTICS_PERIOD
            self._publish_diagnostics(measured, stamp)

    def _publish_pose(self, measured: Measured, stamp: Any) -> None:
        x, y, theta = measured.pose
        sin, cos = math.sin(theta / 2.0), math.cos(theta / 2.0)
        moved = self._moved
        moved.header.stamp = stamp
        pose, twist = moved.pose.pose, moved.twist.twist
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = sin, cos
        twist.linear.x, twist.angular.z = measured.twist
        self._odometry.publish(moved)
        if self._tf is not None:
            transform = self._transform
            transform.header.stamp = stamp
            place = transform.transform
            place.translation.x, place.translation.y = x, y
            place.rotation.z, place.rotation.w = sin, cos
            self._tf.publish(self._ros.TFMessage(transforms=[transform]))

    def _publish_scan(self, measured: Measured, scan: LaserScan) -> None:
        seen = self._seen
        first = measured.stamp + round(scan.stamp * NANOSECONDS)
        seen.header.stamp = make_stamp(self._ros, max(first, 0))
        for name in ("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time"):
            setattr(seen, name, getattr(scan, name))
        seen.range_min, seen.range_max = scan.range_min, scan.range_max
        seen.ranges = scan.ranges
        self._scan.publish(seen)

    def _publish_diagnostics(self, measured: Measured, stamp: Any) -> None:
        ros, config = self._ros, self.config
        kinds = ros.DiagnosticStatus
        stopped = measured.reason is Reason.EMERGENCY_STOP
        late = measured.lateness is not None and self._lateness > config.late_tick
        level, text = kinds.OK, "drives"
        if self.inbox.problem or late:
            level, text = kinds.WARN, self.inbox.problem or "the control loop is late"
        if stopped or measured.reason in (Reason.GEOFENCE, Reason.STALE_FEEDBACK):
            level, text = kinds.ERROR, measured.reason.name.lower().replace("_", " ")
        values = {
            "emergency stop": str(stopped).lower(),
            "why the twist isn't the asked one": measured.reason.name.lower(),
            "age of the feedback [s]": f"{measured.age:.4f}",
            "latest tick [s]": "simulated"
            if measured.lateness is None
            else f"{self._lateness:.6f}",
            "late ticks": f"{self._late_ticks} of {self._ticks}",
            "commands": self.inbox.problem or "taken",
        }
        self._lateness = 0.0
        status = kinds(
            level=level, name=f"{DRIVER_NODE}: link", message=text, hardware_id=self.link
        )
        status.values = [ros.KeyValue(key=key, value=value) for key, value in values.items()]
        array = ros.DiagnosticArray(status=[status])
        array.header.stamp = stamp
        self._diagnostics.publish(array)

    def close(self) -> None:
        """End threads and nodes."""
        self._running = False
        for request in list(self.requests):
            request.answer = "the driver has ended"
            request.done.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(2.0 * SPIN_PERIOD)
        self._unstamped.close()
        self._node.close()


def _remaps(arguments: Sequence[str]) -> list[str]:
    """Return those of ROS's arguments that remap topics, which a second node needs, too."""
    pairs = itertools.pairwise(arguments)
    kept = [
        (option, rule)
        for option, rule in pairs
        if option in ("-r", "--remap") and not rule.startswith(("__node:", "__ns:", "__name:"))
    ]
    return [word for pair in kept for word in pair]


def find_scene(worlds: str, config: RobotConfig) -> Scene:
    """Return the first of some worlds, such as "clutter:7-7" or a file, with its start and goal.

    Raises:
        WorldError: there is none.
    """
    pool = Pool.of(worlds, None, footprint_radius(config), 1, lidar_height(config))
    world = next(iter(pool))
    start, goal = world.start, world.goal
    return Scene((start.x, start.y, start.theta or 0.0), (goal.x, goal.y), world)


def parse_scene(text: str) -> Scene:
    """Return the scene that JSON describes, as of `links.ros2.format_scene`; "" is an open floor.

    Raises:
        ConfigError: it can't be used.
    """
    if not text.strip():
        return Scene()
    try:
        start, goal, world = _read_scene(**json.loads(text))
    except (ValueError, TypeError) as error:
        short = escape_unprintable(" ".join(text.split()), 60)
        raise ConfigError(
            f'scene = {short}: must be like {{"start": [0, 0, 0], "goal": [2, 1], "world": null}}'
        ) from error
    if world is None or isinstance(world, str):
        return Scene(start, goal, load_world(world) if world else None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.json"
        path.write_text(json.dumps(world), encoding="utf-8")
        try:
            return Scene(start, goal, load_world(path))
        except WorldError as error:
            raise WorldError(str(error).replace(str(path), SCENE_PARAMETER)) from error


def _read_scene(
    start: Sequence[float] = (0.0, 0.0, 0.0),
    goal: Sequence[float] | None = None,
    world: object = None,
) -> tuple[tuple[float, float, float], tuple[float, float] | None, object]:
    """Return the values of a scene's names; TypeError or ValueError where they can't be."""
    x, y, theta = map(float, start)
    goal_x, goal_y = map(float, goal or (0.0, 0.0))
    if not all(map(math.isfinite, (x, y, theta, goal_x, goal_y))):
        raise ValueError("not finite")
    return (x, y, theta), (goal_x, goal_y) if goal else None, world


def list_earlier(
    shares: Sequence[tuple[Speeds, float]], stamp: int, angles: Speeds
) -> list[tuple[int, Speeds, Speeds]]:
    """List what odometry integrated in a tick before its end, for who integrates it, too.

    Args:
        shares: wheel speeds [rad/s], and for how long each held [s].
        stamp: of the tick's end [ns].
        angles: of the wheels then [rad].

    Returns:
        Stamps [ns], speeds and angles, the newest left out.
    """
    earlier: list[tuple[int, Speeds, Speeds]] = []
    a, b, c, d = angles
    for (before, _), (speeds, share) in reversed([*itertools.pairwise(shares)]):
        stamp -= round(share * NANOSECONDS)
        e, f, g, h = speeds
        a, b, c, d = a - e * share, b - f * share, c - g * share, d - h * share
        earlier.insert(0, (stamp, before, (a, b, c, d)))
    return earlier


class DrivenRobot:
    """The control loop: a robot that drives what its node hears.

    Args:
        node: of the robot.
        speed: how fast simulated time passes, in parts of real time.
        recorder: records what the robot does.
    """

    def __init__(
        self, node: RobotNode, speed: float = 1.0, recorder: Recorder | None = None
    ) -> None:
        self._node = node
        config = node.config
        link = open_link(node.link or "serial", config, realtime=speed)
        if link.ros is not None:
            raise ConfigError(f"link = {show_value(node.link)}: that robot is in ROS already")
        self._simulated = link.lateness is None
        sensors = (
            sensor_factories(["lidar"], node.lidar or None) if node.lidar or self._simulated else ()
        )
        self._robot = Robot(link, config, sensors, recorder)
        self._scanned = -math.inf
        self._turn: tuple[float, int] | None = None
        self._offset = SIMULATION_START
        self._newest = SIMULATION_START
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
        """Drive until an error or an interrupt; stops and closes on any way out."""
        robot, node = self._robot, self._node
        try:
            self._begin(node.read_scene())
            node.start()
            node.say(f"drives {node.link or node.config.serial_port}")
            while True:
                node.check()
                while node.requests:
                    self._answer(node.requests.popleft())
                robot.drive(*node.inbox.current())
                self._hand_over()
                if robot.safety.reason is Reason.EMERGENCY_STOP and not self._is_held():
                    robot.safety.reset()  # released from another terminal
        finally:
            robot.close()
            node.close()

    def _answer(self, request: Request) -> None:
        """Do what a service asks for; an error is its answer."""
        with contextlib.suppress(ConfigError, LinkError):
            request.run()
        if not self._robot.active:
            self._begin(Scene())

    def _begin(self, scene: Scene) -> None:
        """Reset the robot; stamps go on growing."""
        self._robot.reset(scene)
        link = self._robot.link
        begin = self._newest if self._simulated else self._node.now()
        self._offset = begin - round(link.now() * NANOSECONDS)
        self._scanned = -math.inf

    def _hand_over(self) -> None:
        robot = self._robot
        stamp = self._offset + round(robot.wire.stamp * NANOSECONDS)
        self._newest = stamp
        odometry, safety = robot.odometry, robot.safety
        self._node.put(
            Measured(
                stamp,
                odometry.pose,
                odometry.twist,
                robot.speeds,
                odometry.wheel_positions,
                self._take_scan(),
                robot.link.lateness,
                robot.feedback_age,
                safety.reason,
                list_earlier(robot.shares, stamp, odometry.wheel_positions),
            )
        )

    def _take_scan(self) -> LaserScan | None:
        """Return the newest revolution as a message, if it is new."""
        sensor = find_lidar(self._robot.sensors)
        if sensor is None or sensor.revolution.stamp <= self._scanned:
            return None
        revolution = sensor.revolution
        self._scanned = revolution.stamp
        now = self._robot.wire.stamp
        moved = Revolution(revolution.bearings, revolution.distances, revolution.times - now, 0.0)
        lidar = self._node.config.lidar
        angle_min, rays = self._turn or (None, None)
        scan = make_scan(moved, lidar.min_range, lidar.max_range, angle_min=angle_min, rays=rays)
        if self._turn is None:
            self._turn = scan.angle_min, np.size(scan.ranges)  # programs for maps want them to stay
        return scan

    def _is_held(self) -> bool:
        return is_held() or self._held

    _held = False

    def _estop(self) -> str:
        self._held = True
        self._robot.estop()
        return "stopped; call release to drive again"

    def _release(self) -> str:
        self._held = False
        self._robot.release_estop()
        self._robot.safety.reset()
        return "released"

    def _reset_odometry(self) -> str:
        self._robot.odometry.reset()
        return "the robot is at the origin of its odometry"

    def _reset(self) -> str:
        self._begin(self._node.read_scene())
        return "the robot stands in the scene"
