"""A link to a robot in ROS 2: commands are published, joint states become feedback lines.

Commands are published as the type that the robot's controller subscribes: a twist, or the speeds of
the wheels. Each measurement becomes a line of the wire with the time at which the robot measured
it, so that everything behind the link is the same as for a board on a serial device.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import BoardSilentError, LinkError
from acsar_gym.links.base import WHILE_WAITING, Arrivals
from acsar_gym.links.guarded import GuardedLink
from acsar_gym.protocol import ZERO, Decoder, Reading, Speeds
from acsar_gym.ros.joints import MAX_WHEEL_SPEED, JointReader
from acsar_gym.ros.node import (
    COMMAND_KINDS,
    NANOSECONDS,
    WATCHDOG_SUFFIX,
    RosNode,
    child_environment,
    explain_age,
    interrupts_deferred,
    make_command,
    make_stamp,
    read_stamp,
)
from acsar_gym.ros.scenes import name_world
from acsar_gym.worlds import Scene

DRIVER_NODE = "acsar_driver"
"""Name of the node of `acsar-gym ros driver`, which puts a simulated robot into a scene."""
SCENE_PARAMETER = "scene"
"""Its parameter for the name of a world."""
START_PARAMETER = "start"
"""Its parameter for the robot's place in that world: x [m], y [m], theta [rad]."""
DISCOVERY_TIME = 1.0
"""Shortest time for which other nodes are looked for before the first command [s]."""
MATCH_TIMEOUT = 1.0
"""Longest wait until the robot knows the publisher of commands [s]."""
NAME_TIMEOUT = 5.0
"""Longest wait for the name of a node that commands the robot [s]."""
PUBLISHERS_TIME = 1.0
"""How long a second publisher of the joint states is listened to before the first drive [s]."""
RESET_TIMEOUT = 20.0
"""Longest wait until a simulated robot is in a new scene [s]."""
FEEDBACK_DEPTH = 100
"""Number of joint states that wait while a program doesn't step."""
SLACK = 0.0005
"""Time from a joint state to the end of its tick, if they come at the control rate [s]."""
PHASE_GAIN = 0.2
"""Part of a tick's phase error that the next deadline corrects."""
PHASE_SHARE = 0.05
"""Largest correction of a deadline, as a share of the period."""
KEPT_COMMANDS = 50
"""Number of own commands that are told from those of other nodes."""
KEPT_DELAYS = 1000
"""Number of delays of messages that are kept."""
ZEROS_GRACE = 0.1
"""Zeros of other nodes are ignored for this time after the first command that turns wheels [s]."""
DRAIN_TIMEOUT = 0.1
"""Longest wait until the robot has confirmed the last zeros [s]."""
CLOCK_STEP = 1e-6
"""Precision with which deadlines are met, as a simulated clock advances by whole steps [s]."""
CLOCK_PAUSE = 0.2
"""Without a new time of /clock for this long, the next one is waited for [s]."""
CLOCK_TIMEOUT = 5.0
"""How long /clock may stand still [s]."""
_numbers = itertools.count()


class Ros2Link(GuardedLink):
    """A robot in ROS 2. Its clock is the node's, which starts at 0 when the link is opened.

    The watchdog process has its own node, which publishes zeros.

    Args:
        url: "ros2", or "ros2:/namespace".
        config: Robot configuration. `config.ros2` names topics and joints.

    Attributes:
        node: Node of the open link. None while it is closed.
        command_topic: Full name of the topic of commands.
        command_kind: Kind of the commands, see `COMMAND_KINDS`.
        feedback_topic: Full name of the topic of the wheels' speeds.
        uses_sim_time: Whether time is that of /clock.
        epoch: Time of ROS at which the link's clock is 0 [ns].
        places_robot: Whether a reset puts a simulated robot into the scene.
        is_simulated: Whether the last reset did so. The robot is one of `acsar-gym ros driver`.
        delays: Delays of the newest messages of the wheels, from their stamps to their arrival [s].
    """

    stamped = True
    watchdog_start = 20.0  # it imports ROS and finds the robot

    def __init__(self, url: str, config: RobotConfig) -> None:
        self.node: RosNode | None = None
        self.epoch = 0
        self.places_robot = True
        self.is_simulated = False
        self._namespace = url.partition(":")[2] or "/"
        self._geometry = config.twist_geometry
        super().__init__(url, config)
        self._forget()

    def _forget(self) -> None:
        """Set everything to its state before the first message."""
        self._publisher: Any = None
        self.command_topic = ""
        self.command_kind = ""
        self.feedback_topic = ""
        self.uses_sim_time = False

        self.epoch = 0
        self._previous_now = 0.0
        self._clock_moved = time.monotonic()
        self._commands = Decoder()
        self._speeds: Speeds = ZERO
        self._sent: deque[tuple[Any, ...]] = deque(maxlen=KEPT_COMMANDS)
        self._driving_since: float | None = None
        self._is_intruded = False

        self._messages = 0
        self._sources: set[Any] = set()
        self._reader = JointReader(self._config.ros_joints)
        self._arrivals: Arrivals = []
        self._pending: list[tuple[float, bytes]] = []
        self._newest = 0.0
        self._heard = 0.0
        self._advanced = 0.0
        self._problem = ""
        self.delays: deque[float] = deque(maxlen=KEPT_DELAYS)

    @property
    def ros(self) -> Ros2Link:
        """This link."""
        return self

    @property
    def is_open(self) -> bool:
        """Whether the node exists."""
        return self.node is not None

    @property
    def commands_sides(self) -> bool:
        """Whether the robot takes twists, or has two wheels. Known while the link is open."""
        return self.command_kind != "wheel_speeds" or self._config.has_two_wheels

    @property
    def commanders(self) -> list[str]:
        """Other nodes that publish commands."""
        return self._require_node().list_commanders(self.command_topic)

    @property
    def feedback_publishers(self) -> list[str]:
        """Nodes that publish the feedback's topic."""
        return self._require_node().list_publishers(self.feedback_topic)

    @property
    def refused(self) -> str:
        """Why messages of the wheels were refused, and how many. Empty if none was."""
        return ", ".join(f"{count} {kind}" for kind, count in self._reader.refused.items())

    # Opening

    def _connect(self) -> None:
        """Find the robot, and publish nothing if another node commands it."""
        self._forget()
        start = time.monotonic()
        self.node = node = RosNode(f"acsar_gym_{os.getpid()}_{next(_numbers)}", self._namespace)
        try:
            self._find_controller(node)
            self._find_feedback(node)
            self._start_clock(node)

            # A node that commands the robot is found as soon as the robot, or a bit later.
            discovery_time = max(DISCOVERY_TIME, time.monotonic() - start)
            self._wait(lambda: self.commanders, discovery_time)
            # A publisher, or its first command, may be known before the name of its node.
            if self._is_intruded or node.has_nameless_publisher(self.command_topic):
                self._wait(lambda: self.commanders, NAME_TIMEOUT)
            self._refuse_commanders()
            self._make_publisher(node)
        except BaseException:
            self._disconnect(lost=False)
            raise

    def _find_controller(self, node: RosNode) -> None:
        """Find the subscription of commands and its type."""
        settings = self._config.ros2
        self.command_topic = node.resolve(settings.command_topic)
        # The best kind that the robot subscribes, unless its file names one.
        wanted = [settings.command] if settings.command else [*COMMAND_KINDS]

        def find_kind() -> str:
            types = node.list_subscribed_types(self.command_topic)
            return next((kind for kind in wanted if COMMAND_KINDS[kind] in types), "")

        self._wait(find_kind)
        self.command_kind = find_kind()
        if not self.command_kind:
            kinds = f"{COMMAND_KINDS[wanted[0]]} on " if settings.command else ""
            raise LinkError(
                f"{self.device}: no node subscribes {kinds}{self.command_topic} "
                f"({self._config.connect_timeout:g} s)",
                self._suggest_topic(node, "command_topic", *COMMAND_KINDS.values()),
            )
        self._command = make_command(node.ros, self.command_kind, self._config.base_frame)
        kind = type(self._command)
        node.subscribe(
            self.command_topic, kind, self._take_command, KEPT_COMMANDS, best_effort=True
        )

    def _find_feedback(self, node: RosNode) -> None:
        """Find the topic with the wheels' speeds, and wait for its first message."""
        settings = self._config.ros2
        timeout = self._config.connect_timeout
        joints = node.resolve(settings.joint_states_topic)
        odom = node.resolve(settings.odom_topic)
        topics = {"joint_states": [joints], "odom": [odom], None: [joints, odom]}
        choices = topics[settings.feedback]
        # Joint states are better than odometry, so they are waited for first.
        self._wait(lambda: node.list_publishers(choices[0]))
        published = [topic for topic in choices if node.list_publishers(topic)]
        if not published:
            raise LinkError(
                f"{self.device}: no node publishes {choices[0]} ({timeout:g} s)",
                self._suggest_topic(node, "joint_states_topic", "sensor_msgs/msg/JointState"),
            )

        self.feedback_topic = published[0]
        kind = node.ros.JointState
        callback: Callable[..., None] = self._take_joints
        if self.feedback_topic == odom:
            kind = node.ros.Odometry
            callback = self._take_odometry
        node.subscribe(self.feedback_topic, kind, callback, FEEDBACK_DEPTH, best_effort=True)
        # With the first message, the robot's other topics are known as well, such as /clock.
        has_messages = self._wait(lambda: self._messages or node.problem)
        self._check_qos(node)
        if not has_messages:
            raise self._silence_error(timeout)

    def _suggest_topic(self, node: RosNode, field: str, *types: str) -> str:
        """Suggest topics of these types for a field of the robot's file."""
        topics = [
            f"{name} ({kind})"
            for name, kinds in node.node.get_topic_names_and_types()
            for kind in kinds
            if kind in types and name not in (self.command_topic, self.feedback_topic)
        ]
        if topics:
            return f"set ros2.{field} in the robot's file; there is {', '.join(sorted(topics)[:4])}"
        return "start the robot's driver, and check ROS_DOMAIN_ID and the namespace of both"

    def _start_clock(self, node: RosNode) -> None:
        use_sim_time = self._config.ros2.use_sim_time
        if use_sim_time is None:
            # A simulation that publishes /clock stamps by it as well.
            use_sim_time = bool(node.list_publishers("/clock"))
        self.uses_sim_time = use_sim_time
        if use_sim_time:
            node.use_sim_time()
            if not self._wait(node.now, CLOCK_TIMEOUT):
                raise LinkError(
                    f"{self.device}: nothing on /clock for {CLOCK_TIMEOUT:g} s",
                    "start the simulation, or set use_sim_time: false in ros2 of the robot's file",
                )
        self.epoch = node.now()

    def _make_publisher(self, node: RosNode) -> None:
        publisher = self._publisher = node.publish(self.command_topic, type(self._command))
        self._wait(lambda: node.problem or publisher.get_subscription_count() > 1, MATCH_TIMEOUT)
        self._check_qos(node)

    def _wait_for_feedback(self) -> None:
        """Wait for the first speeds of all wheels, which only one node may publish."""
        if not self._wait(lambda: self._pending):
            raise self._silence_error(self._config.connect_timeout)
        self._advanced = self.now()
        # The second publisher may have other joints, such as those of an arm.
        if len(self.feedback_publishers) > 1:
            self._wait(lambda: len(self._sources) > 1, PUBLISHERS_TIME)
        self._refuse_publishers()

    def _wait(self, condition: Callable[[], Any], timeout: float | None = None) -> bool:
        """Spin until a condition holds. Return whether it does, by default in `connect_timeout`."""
        timeout = self._config.connect_timeout if timeout is None else timeout
        return self._require_node().wait_until(condition, timeout, self._poll)

    def _check_qos(self, node: RosNode) -> None:
        if node.problem:
            raise LinkError(
                f"{self.device}: {node.problem}",
                "the robot's node must offer and request no more than reliable, volatile topics",
            )

    def _poll(self) -> None:
        WHILE_WAITING.get()()
        self._beat()

    def _refuse_commanders(self) -> None:
        """Raise LinkError if another node publishes commands."""
        commanders = self.commanders
        if commanders or self._is_intruded:
            raise LinkError(
                f"{self.command_topic}: another node commands the robot "
                f"({', '.join(commanders) or 'a node without a name'})",
                "end it, or let a twist_mux choose (a node that was killed is listed for 20 s)",
            )

    def _refuse_publishers(self) -> None:
        """Raise LinkError if two nodes publish joint states of the wheels."""
        if len(self._sources) < 2:
            return
        names = self.feedback_publishers
        if len(names) > 1:
            raise LinkError(
                f"{self.feedback_topic}: two nodes publish the wheels' joint states "
                f"({', '.join(names)})",
                "end one of them, such as a joint_state_publisher, or let it publish other joints",
            )
        self._sources.clear()  # the robot's node was started again

    def _start_watchdog(self) -> None:
        node = self._require_node()
        settings = {
            "name": f"{node.name}{WATCHDOG_SUFFIX}",
            "topic": self.command_topic,
            "kind": self.command_kind,
            "joints": len({*self._config.ros_joints}),
            "subscriptions": max(self._publisher.get_subscription_count(), 2),
            "sim_time": self.uses_sim_time,
        }
        command = (sys.executable, "-m", "acsar_gym.guard.ros_watchdog_child")
        self.watchdog.launch(command, (json.dumps(settings),), environment=child_environment())

    def _silence_error(self, age: float) -> LinkError:
        """Return the error for a robot whose wheels' speeds don't arrive."""
        topic = self.feedback_topic
        if self._problem:
            return BoardSilentError(
                f"{topic}: no message that can be used for {age:.2f} s: {self._problem}",
                "correct its publisher, or name joints and frames in the robot's file",
            )
        return BoardSilentError(
            f"{topic}: no message for {age:.2f} s",
            f"check the robot's driver: ros2 topic hz {topic}",
        )

    # Messages that arrive

    def to_link_time(self, nanoseconds: int) -> float:
        """Convert a time of ROS to the link's clock [s]."""
        return (nanoseconds - self.epoch) / NANOSECONDS

    def _take_joints(self, message: Any, info: Any) -> None:
        if not self._reader.names_wheels(message.name):
            joints = ", ".join(dict.fromkeys(self._config.ros_joints))
            self._problem = f"joint_states has none of {joints} (it has {', '.join(message.name)})"
        # Before Kilted, ROS doesn't identify publishers: they differ by what they fill.
        elif gid := info.get("publisher_gid"):
            self._sources.add(gid["data"])
        else:
            self._sources.add((*message.name, len(message.velocity), message.header.frame_id))

        when = self._read_stamp(message)
        if when is None:
            return
        speeds = self._reader.read(message.name, message.position, message.velocity, when)
        if speeds is not None:
            self._take_speeds(when, speeds)
        elif self._reader.reason:
            self._problem = self._reader.reason

    def _take_odometry(self, message: Any) -> None:
        when = self._read_stamp(message)
        if when is None or when <= self._newest:
            return
        frame = message.child_frame_id
        base = self._config.base_frame
        if frame.lstrip("/") not in ("", base):
            self._problem = f"its child_frame_id is {frame!r}, not {base!r} (base_frame)"
            return

        twist = (message.twist.twist.linear.x, message.twist.twist.angular.z)
        sides = kinematics.compute_sides(*twist, *self._geometry, float("inf"))
        if max(map(abs, sides)) < MAX_WHEEL_SPEED:
            right_speed, left_speed = sides
            self._take_speeds(when, (right_speed, left_speed, left_speed, right_speed))
        else:
            self._problem = f"its twist is {twist}"

    def _read_stamp(self, message: Any) -> float | None:
        """Return a message's time on the link's clock [s]. None if that can't be right."""
        self._messages += 1
        if not self.epoch:
            return None
        stamp = read_stamp(message.header.stamp)
        if not stamp:
            self._problem = "its header has no stamp"
            return None
        when = self.to_link_time(stamp)
        age = self.now() - when
        if abs(age) > self._config.feedback_timeout:
            self._problem = f"its stamp {explain_age(age, simulated=self.uses_sim_time)}"
            return None
        return when

    def _take_speeds(self, when: float, speeds: Speeds) -> None:
        if (encoders := self._config.wheels.encoders) is not None:
            speeds = encoders.to_wire(speeds)
        # Six decimals, more than a board's line has, so that no speed is rounded.
        line = ",".join(
            f"{letter}{'p' if speed >= 0.0 else 'n'}{abs(speed):09.6f}"
            for letter, speed in zip("abcd", speeds, strict=True)
        )
        self._pending.append((when, f"{line}\r\n".encode()))
        self._newest = when
        self._heard = self.now()
        self._problem = ""
        self.delays.append(self._heard - when)

    def _take_command(self, message: Any) -> None:
        """Find commands of other nodes among those that the robot gets."""
        self._messages += 1
        # The link also gets its own commands.
        content = read_command(message)
        if content in self._sent:
            return
        since = self._driving_since
        late = since is not None and time.monotonic() - since > ZEROS_GRACE
        if any(content[-1]) or (late and not self.watchdog.has_tripped):
            self._is_intruded = True

    # Commands

    def _is_stop(self, data: bytes) -> bool:
        for reading in self._commands.feed(data):
            self._speeds = reading.over(ZERO)
        return not any(self._speeds)

    def _send(self, data: bytes) -> None:
        self._publish(self._speeds)

    def _send_stop(self) -> bool:
        try:
            self._publish(ZERO)
        except Exception:  # noqa: BLE001 - rclpy has no common class, and its context may have ended
            return False
        return self._publisher is not None

    def _drain(self) -> bool:
        try:
            duration = self._require_node().make_duration(DRAIN_TIMEOUT)
            return bool(self._publisher.wait_for_all_acked(duration))
        except Exception:  # noqa: BLE001 - as in `_send_stop`
            return False

    def _publish(self, speeds: Speeds) -> None:
        """Publish wheel speeds [rad/s] as the robot's type of command."""
        node = self.node
        if node is None or self._publisher is None:
            return
        if not any(speeds):
            self._driving_since = None
        elif self._driving_since is None:
            self._driving_since = time.monotonic()
        if (motors := self._config.wheels.motors) is not None:  # letters of a board's wire
            speeds = Reading(motors.to_wheels(speeds)).over(ZERO)

        command = self._command
        a, b, c, d = speeds
        if self.command_kind == "wheel_speeds":
            # Both wheels of a side are one joint on a robot with two wheels.
            joints = self._config.ros_joints
            if self._config.has_two_wheels:
                speeds = ((a + d) / 2.0, (b + c) / 2.0, (b + c) / 2.0, (a + d) / 2.0)
            wheels = dict(zip(joints, speeds, strict=True))
            command.data = [wheels[name] for name in self._config.ros2.command_joints or joints]
        else:
            is_stamped = self.command_kind == "twist_stamped"
            twist = command.twist if is_stamped else command
            twist.linear.x, twist.angular.z = kinematics.compute_twist(a, b, c, d, *self._geometry)
            if is_stamped:
                command.header.stamp = make_stamp(node.ros, self._command_time(node, speeds))
        self._sent.append(read_command(command))
        with interrupts_deferred():
            self._publisher.publish(command)

    def _command_time(self, node: RosNode, speeds: Speeds) -> int:
        """Return the stamp of a command [ns]. 0 means now.

        A controller refuses old commands, and /clock is as old as the newest spin.
        """
        is_stale = time.monotonic() - self._clock_moved > CLOCK_PAUSE
        return 0 if self.uses_sim_time and (is_stale or not any(speeds)) else node.now()

    # Driving

    def _prepare(self, scene: Scene) -> None:
        if self.places_robot:
            self._place_robot(self._require_node(), scene)

    def _forget_feedback(self) -> None:
        self._wait(lambda: False, DRAIN_TIMEOUT)  # for messages that arrived while nothing spun
        self._is_intruded = False
        self._pending = []
        self._heard = self.now()
        self._advanced = self._heard

    def _place_robot(self, node: RosNode, scene: Scene) -> None:
        """Put a simulated robot of `acsar-gym ros driver` into a scene, if there is one."""
        prefix = f"{node.namespace.rstrip('/')}/{DRIVER_NODE}"
        # Only a driver with a simulated robot offers this service.
        services = {name for name, _ in node.node.get_service_names_and_types()}
        self.is_simulated = f"{prefix}/reset" in services
        if not self.is_simulated:
            return

        ros = node.ros
        values = {
            SCENE_PARAMETER: name_world(scene.world, self._config),
            START_PARAMETER: [float(number) for number in scene.start],
        }
        request = ros.SetParameters.Request()
        request.parameters = [
            ros.parameter.Parameter(name, value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        self._call(node, ros.SetParameters, f"{prefix}/set_parameters", request)
        answer = self._call(node, ros.Trigger, f"{prefix}/reset", ros.Trigger.Request())
        if not answer.success:
            raise LinkError(f"{prefix}/reset: {answer.message}", "see the output of its driver")

    def _call(self, node: RosNode, kind: Any, name: str, request: Any) -> Any:
        """Call a service, and wait for its answer."""
        client = node.node.create_client(kind, name)
        future = client.call_async(request)
        try:
            if not self._wait(future.done, RESET_TIMEOUT):
                raise LinkError(f"{name}: no answer in {RESET_TIMEOUT:g} s", "is its node alive?")
            return future.result()
        finally:
            node.node.destroy_client(client)

    def advance(self, period: float) -> bytes:
        """Spin until the absolute deadline of the period [s]. Return the lines that have arrived.

        The deadlines' phase follows the joint states. After a delay of more than a period they
        restart from now.

        Raises:
            LinkError: The robot is silent, another node commands it, or the clock jumped back.
        """
        node = self._require_node()
        self._catch_up()
        if self.now() - self._advanced > CLOCK_PAUSE:  # the program paused
            self._heard = self.now()
        self._deadline += period
        while True:
            earlier = self._check_clock()
            # Messages that have arrived are all handled before the period ends.
            messages = self._messages
            node.spin(min(self._deadline - earlier, self.watchdog.beat_interval, period))
            self._beat()
            now = self.now()
            has_jumped = self.uses_sim_time and now != earlier
            is_idle = messages == self._messages and not has_jumped
            if is_idle and self._deadline - now <= CLOCK_STEP:
                break

        self.lateness = now - self._deadline
        if self.lateness > period:
            self._deadline = now
        self._arrivals = self._pending
        self._pending = []
        if self._arrivals and not self.uses_sim_time:
            self._follow_phase(self._heard - self._deadline, period)
        if self._is_intruded and self._driving_since is not None:
            self._refuse_commanders()
        self._is_intruded = False
        self._refuse_publishers()
        self._advanced = now
        if now - self._heard > self._config.feedback_timeout:
            raise self._silence_error(now - self._heard)
        return b"".join([line for _, line in self._arrivals])

    def _catch_up(self) -> None:
        """Receive the simulated time again after a pause in which nothing spun.

        For the node it stood still meanwhile, so that waiting messages seem to be of the future.
        """
        if not self.uses_sim_time or time.monotonic() - self._clock_moved < CLOCK_PAUSE:
            return
        earlier = self.now()
        self._wait(lambda: self.now() != earlier, CLOCK_TIMEOUT)
        self._clock_moved = time.monotonic()
        self._wait(lambda: self._pending, self._config.feedback_timeout)

    def _follow_phase(self, arrived: float, period: float) -> None:
        """Move the deadlines towards `SLACK` after the arrivals, which is before the deadline."""
        error = (arrived + SLACK + period / 2.0) % period - period / 2.0
        limit = PHASE_SHARE * period
        self._deadline += min(max(PHASE_GAIN * error, -limit), limit)

    def _check_clock(self) -> float:
        """Return the link's time [s]. LinkError if it jumped back, or stands still."""
        now = self.now()
        real = time.monotonic()
        step = now - self._previous_now
        self._previous_now = now
        if step:
            self._clock_moved = real

        source = "/clock" if self.uses_sim_time else "the clock of this computer"
        if step < 0.0:
            raise LinkError(f"{self.device}: {source} jumped back by {-step:.3f} s", "reset")
        if real - self._clock_moved > CLOCK_TIMEOUT:
            raise LinkError(
                f"{self.device}: {source} stands still for {CLOCK_TIMEOUT:g} s",
                "let the simulation go on",
            )
        return now

    @property
    def arrivals(self) -> Arrivals:
        """The lines of the newest period, and when the robot measured each [s]."""
        return self._arrivals

    def now(self) -> float:
        """Return the time of the node's clock since the opening [s]. 0 while closed."""
        return self.to_link_time(self.node.now()) if self.node is not None else 0.0

    def ros_time(self) -> int:
        """Return the time of ROS [ns]. 0 while closed."""
        return self.node.now() if self.node is not None else 0

    def _disconnect(self, *, lost: bool) -> None:
        node = self.node
        self._detach()
        if node is not None:
            node.close()

    def _detach(self) -> None:
        self.node = None
        self._publisher = None

    def _require_node(self) -> RosNode:
        if self.node is None:
            raise self._closed_error()
        return self.node


def read_command(message: Any) -> tuple[Any, ...]:
    """Return the stamp and the numbers of a command, by which it is recognized."""
    if hasattr(message, "data"):
        return (tuple(message.data),)
    if hasattr(message, "header"):
        twist = message.twist
        return read_stamp(message.header.stamp), (twist.linear.x, twist.angular.z)
    return ((message.linear.x, message.angular.z),)
