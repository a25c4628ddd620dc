"""A link to a robot that is in ROS 2: commands are published, joint states become feedback lines.

Commands go out as what the robot's controller takes: a twist, or the speeds of the wheels. What
comes back is written as lines of the wire, each with the time at which the robot measured it, so
that everything behind the link is the same as for a board on a serial device.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Iterator
from typing import Any

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import BoardSilentError, LinkError, LinkLostError, SafetyWarning
from acsar_gym.guard.shutdown import (
    check_may_drive,
    check_may_start,
    close_at_exit,
    forget_link,
    install_handlers,
)
from acsar_gym.guard.watchdog import Watchdog
from acsar_gym.links.base import WHILE_WAITING, Arrivals, Link
from acsar_gym.protocol import ZERO, Decoder, Reading, Speeds
from acsar_gym.ros.joints import JointReader
from acsar_gym.ros.node import (
    COMMAND_KINDS,
    NANOSECONDS,
    RosNode,
    child_environment,
    make_command,
    make_stamp,
    read_stamp,
)
from acsar_gym.worlds import Scene
from acsar_gym.worlds.files import format_world

DRIVER_NODE = "acsar_driver"
"""Name of the node of `acsar-gym ros driver`, which puts a simulated robot into a scene."""
SCENE_PARAMETER = "scene"
WATCHDOG_SUFFIX = "_watchdog"
"""End of the name of a watchdog's node; it commands nothing but zeros."""
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""What ROS calls a node, such as our watchdog's, before it has heard its name."""
WATCHDOG_START = 20.0
"""Longest wait for the watchdog, which imports ROS and finds the robot [s]."""
WATCHDOG_TRANSPORT = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
"""A program that is killed may leave shared memory locked, of Fast DDS's other transport."""
RESET_TIMEOUT = 20.0
"""Longest wait until a simulated robot stands in a new scene [s]."""
FEEDBACK_DEPTH = 100
"""How many joint states wait while a program doesn't step."""
SLACK = 0.0005
"""Ticks end so long after a joint state, where these come at the control rate [s]."""
PHASE_GAIN, PHASE_SHARE = 0.2, 0.05
"""Part of a tick's phase error that the next deadline mends, and at most which part of a period."""
KEPT_COMMANDS = 50
"""How many commands are told apart from those of other nodes."""
KEPT_DELAYS = 1000
"""How many delays of messages are kept."""
OTHERS_GRACE = 0.1
"""Zeros of others count from so long after the first command that turns wheels [s]."""
KINDS_TIMEOUT = 0.5
"""Longest wait for a robot that takes stamped twists besides others [s]."""
DRAIN_TIMEOUT = 0.1
"""Longest wait until the robot has confirmed the last zeros [s]."""
CLOCK_STEP = 1e-6
"""Deadlines are met so exactly; a simulated clock goes on by whole steps [s]."""
CLOCK_PAUSE = 0.2
"""After so long without a new time of /clock it is waited for [s]."""
CLOCK_TIMEOUT = 5.0
"""How long /clock may stand still [s]."""
_numbers = itertools.count()


class Ros2Link(Link):
    """A robot in ROS 2. Its clock is the node's, from the opening on.

    While open, a watchdog process with a node of its own commands zero if this process dies, or
    hangs longer than `watchdog_timeout` while wheels turn.

    Attributes: `device`, the URL; `lateness`; `watchdog`; `node`, None while closed; `epoch`, the
    node's time at which the link's clock is 0 [ns]; `places_robot`, whether a reset puts a
    simulated robot into the scene; `delays`, by how much the newest messages of the wheels arrived
    after their stamps [s].

    Args:
        url: "ros2", or "ros2:/namespace".
        config: of the robot; `config.ros2` names topics and joints.
    """

    is_real = True
    stamped = True
    lateness = 0.0

    @property
    def ros(self) -> Ros2Link:
        """This link."""
        return self

    def __init__(self, url: str, config: RobotConfig) -> None:
        self.device = url
        self._config = config
        self._namespace = url.partition(":")[2] or "/"
        self.watchdog = Watchdog(b"", config.watchdog_timeout)
        self.node: RosNode | None = None
        self.places_robot = True
        self.epoch = 0
        self._geometry = config.twist_geometry
        self._forget()
        self._make_locks()
        install_handlers()

    def _forget(self) -> None:
        """Set everything to what it is before the first message."""
        self._deadline = self._heard = self._newest = 0.0
        self._clock_moved = time.monotonic()
        self._sim_time = False
        self._handled = self._echoed = 0
        self._arrivals: Arrivals = []
        self._pending: list[tuple[float, bytes]] = []
        self._commands = Decoder()
        self._reader = JointReader(self._config.ros_joints)
        self._sent: deque[tuple[Any, ...]] = deque(maxlen=KEPT_COMMANDS)
        self._driving_since: float | None = None
        self._intruded = False
        self._quiet = 0.0
        self._problem = ""
        self._kind = self._feedback = ""
        self._publisher: Any = None
        self.delays: deque[float] = deque(maxlen=KEPT_DELAYS)

    def _make_locks(self) -> None:
        self._lock = threading.RLock()  # a signal handler may run while this thread holds it

    @property
    def unwatched(self) -> str:
        """Why no watchdog watches the open link; empty where one does."""
        if self._config.watchdog_timeout is None:
            return "watchdog_timeout: null"
        return "" if self.watchdog.is_started else "not on this system"

    @property
    def topics(self) -> dict[str, str]:
        """Full names of the topics "commands" and "feedback"; "type" of commands; "clock"."""
        node, settings = self._require_node(), self._config.ros2
        odom = self._feedback == "odom"
        return {
            "commands": node.resolve(settings.command_topic),
            "type": COMMAND_KINDS[self._kind],
            "clock": "/clock" if self._sim_time else "the computer's",
            "feedback": node.resolve(settings.odom_topic if odom else settings.joint_states_topic),
        }

    @property
    def others(self) -> list[str]:
        """Nodes beside this one that may command the robot."""
        return self._list_others(self._require_node())

    @property
    def refused(self) -> str:
        """Why messages of the wheels were refused, and how many; empty where none was."""
        return ", ".join(f"{count} {kind}" for kind, count in self._reader.refused.items())

    @property
    def commands_sides(self) -> bool:
        """Whether the robot takes twists, or has two wheels; known while open."""
        return self._kind != "wheel_speeds" or self._config.has_two_wheels

    def open(self) -> None:
        """Find the robot's topics, command zero, and wait for its wheels' speeds. Idempotent.

        Raises:
            MissingRosError: ROS 2 isn't installed.
            LinkError: nobody takes commands or says how fast the wheels turn, or otherwise than
                expected; the message says what was found.
        """
        if self.node is not None:
            return
        check_may_start()
        self._forget()
        name = f"acsar_gym_{os.getpid()}_{next(_numbers)}"
        self.node = node = RosNode(name, self._namespace)
        close_at_exit(self)
        try:
            self._find_controller(node)
            self._find_feedback(node)
            self._start_clock(node)
            self._publish(ZERO)
            self._start_watchdog(node)
            self._wait_for_wheels(node)
            self.watchdog.wait_ready(WATCHDOG_START)
            self._warn_of_others(node)
        except BaseException:
            self.close()
            raise
        self._deadline = self.now()

    def _find_controller(self, node: RosNode) -> None:
        """Find who takes commands, and which kind; publish a zero."""
        settings = self._config.ros2
        topic = node.resolve(settings.command_topic)

        def list_kinds() -> list[str]:
            types = {kind for _, kind in node.list_peers(topic, publishers=False)}
            return [kind for kind in COMMAND_KINDS if COMMAND_KINDS[kind] in types]

        wanted = settings.command
        timeout = self._config.connect_timeout
        node.wait_until(
            lambda: wanted in list_kinds() if wanted else list_kinds(),
            timeout,
            WHILE_WAITING.get(),
        )
        preferred = next(iter(COMMAND_KINDS))
        if wanted is None and list_kinds():  # a robot may take several, and one is heard of first
            node.wait_until(lambda: preferred in list_kinds(), KINDS_TIMEOUT, WHILE_WAITING.get())
        kinds = list_kinds()
        if not kinds or (wanted and wanted not in kinds):
            takes = f"{COMMAND_KINDS[wanted]} on {topic}" if wanted else topic
            raise LinkError(
                f"{self.device}: no node subscribes {takes} ({timeout:g} s)",
                self._suggest_topic(node, tuple(COMMAND_KINDS.values()), "command_topic"),
            )
        self._kind = wanted or kinds[0]
        self._command = make_command(node.ros, self._kind, self._config.base_frame)
        self._publisher = node.publish(topic, type(self._command))
        node.subscribe(topic, type(self._command), self._on_command, KEPT_COMMANDS)
        node.wait_until(lambda: node.problem or self._publisher.get_subscription_count() > 1, 1.0)
        self._check_qos(node)

    def _warn_of_others(self, node: RosNode) -> None:
        """Warn (SafetyWarning) of other nodes that may command the robot."""
        others = self._list_others(node)
        if others:
            warnings.warn(
                f"{node.resolve(self._config.ros2.command_topic)}: others publish it, too "
                f"({', '.join(others)}), and the robot obeys the newest command: end them, or let "
                "a twist_mux choose",
                SafetyWarning,
                5,
            )

    def _list_others(self, node: RosNode) -> list[str]:
        """List the nodes beside this one and its watchdog that may publish commands."""
        mine = f"/{node.name}"
        topic = self._config.ros2.command_topic
        names = dict.fromkeys(name for name, _ in node.list_peers(topic, publishers=True))
        ours = (mine, f"{mine}{WATCHDOG_SUFFIX}", UNKNOWN_NODE)
        return [name for name in names if not name.endswith(ours)]

    def _suggest_topic(self, node: RosNode, types: tuple[str, ...], field: str) -> str:
        """Say which topics of these types there are."""
        topics = [
            f"{name} ({kind})"
            for name, kinds in node.node.get_topic_names_and_types()
            for kind in kinds
            if kind in types and name != node.resolve(getattr(self._config.ros2, field))
        ]
        if topics:
            return f"set ros2.{field} in the robot's file; there is {', '.join(sorted(topics)[:4])}"
        return "start the robot's driver, and check ROS_DOMAIN_ID and the namespace of both"

    def _start_watchdog(self, node: RosNode) -> None:
        settings = {
            "name": f"{node.name}{WATCHDOG_SUFFIX}",
            "topic": node.resolve(self._config.ros2.command_topic),
            "kind": self._kind,
            "joints": len({*self._config.ros_joints}),
            "subscriptions": max(self._publisher.get_subscription_count(), 2),
            "sim_time": self._sim_time,
        }
        command = (sys.executable, "-m", "acsar_gym.guard.ros_watchdog_child")
        with self._lock:
            environment = WATCHDOG_TRANSPORT | child_environment()
            self.watchdog.launch(command, (json.dumps(settings),), environment=environment)

    def _find_feedback(self, node: RosNode) -> None:
        """Find who says how fast the wheels turn."""
        settings, ros = self._config.ros2, node.ros
        topics = {
            "joint_states": (settings.joint_states_topic, ros.JointState, self._on_joints),
            "odom": (settings.odom_topic, ros.Odometry, self._on_odometry),
        }
        kinds = [settings.feedback] if settings.feedback else [*topics]

        def find() -> str:
            return next((k for k in kinds if node.list_peers(topics[k][0], publishers=True)), "")

        timeout = self._config.connect_timeout
        node.wait_until(lambda: find() == kinds[0], timeout, WHILE_WAITING.get())
        self._feedback = find()
        if not self._feedback:
            name, field = node.resolve(topics[kinds[0]][0]), f"{kinds[0]}_topic"
            types = ("sensor_msgs/msg/JointState",)
            raise LinkError(
                f"{self.device}: no node publishes {name} ({timeout:g} s)",
                self._suggest_topic(node, types, field),
            )
        topic, kind, callback = topics[self._feedback]
        node.subscribe(topic, kind, callback, FEEDBACK_DEPTH, best_effort=True)
        # When it is heard, the robot's other topics are known as well, /clock among them.
        node.wait_until(lambda: self._handled or node.problem, timeout, WHILE_WAITING.get())
        self._check_qos(node)
        if not self._handled:
            raise self._silence_error(timeout)

    def _start_clock(self, node: RosNode) -> None:
        wanted = self._config.ros2.use_sim_time
        self._sim_time = (
            bool(node.list_peers("/clock", publishers=True)) if wanted is None else wanted
        )
        if self._sim_time:
            node.use_sim_time()
            if not node.wait_until(node.now, CLOCK_TIMEOUT, WHILE_WAITING.get()):
                raise LinkError(
                    f"{self.device}: nothing on /clock for {CLOCK_TIMEOUT:g} s",
                    "start the simulation, or say use_sim_time: false in ros2 of the robot's file",
                )
        self.epoch = node.now()
        self._now_before = self._newest = 0.0
        self._pending, self._problem = [], ""
        self._reader = JointReader(self._config.ros_joints)

    def _wait_for_wheels(self, node: RosNode) -> None:
        """Wait for the first speeds of all wheels."""
        timeout = self._config.connect_timeout
        node.wait_until(lambda: self._pending or node.problem, timeout, WHILE_WAITING.get())
        self._check_qos(node)
        if not self._pending:
            raise self._silence_error(timeout)

    def _check_qos(self, node: RosNode) -> None:
        if node.problem:
            raise LinkError(
                f"{self.device}: {node.problem}",
                "the robot's node must offer and ask for no more than reliable, volatile topics",
            )

    def _silence_error(self, age: float) -> LinkError:
        """Return the error for a robot that doesn't say how fast its wheels turn."""
        topic = self.topics["feedback"]
        if self._problem:
            return BoardSilentError(
                f"{topic}: nothing that can be used for {age:.2f} s: {self._problem}",
                "mend what publishes it, or name joints and frames in the robot's file",
            )
        return BoardSilentError(
            f"{topic}: no message for {age:.2f} s",
            f"check the robot's driver: ros2 topic hz {topic}",
        )

    # What arrives

    def to_link_time(self, nanoseconds: int) -> float:
        """Convert a time of ROS to the link's clock [s]."""
        return (nanoseconds - self.epoch) / NANOSECONDS

    def _on_joints(self, message: Any) -> None:
        self._handled += 1
        when = self._check_stamp(message)
        if when is None:
            return
        refused = self._reader.refused.total()
        speeds = self._reader.read(message.name, message.position, message.velocity, when)
        if speeds is not None:
            self._take_speeds(when, speeds)
        elif self._reader.refused.total() > refused:
            self._problem = self._reader.reason
        elif not {*message.name} & {*self._config.ros_joints}:
            joints = ", ".join(dict.fromkeys(self._config.ros_joints))
            self._problem = f"joint_states has none of {joints} (it has {', '.join(message.name)})"

    def _on_odometry(self, message: Any) -> None:
        self._handled += 1
        when = self._check_stamp(message)
        if when is None or when <= self._newest:
            return
        frame, base = message.child_frame_id, self._config.base_frame
        if frame.lstrip("/") not in ("", base):
            self._problem = f"its child_frame_id is {frame!r}, not {base!r} (base_frame)"
            return
        twist = message.twist.twist.linear.x, message.twist.twist.angular.z
        sides = kinematics.compute_sides(*twist, *self._geometry, float("inf"))
        if not all(abs(speed) < 1e3 for speed in sides):
            self._problem = f"its twist is {twist}"
            return
        right, left = sides
        self._take_speeds(when, (right, left, left, right))

    def _check_stamp(self, message: Any) -> float | None:
        """Return a message's time on the link's clock [s]; None where that can't be."""
        stamp = read_stamp(message.header.stamp)
        if not stamp:
            self._problem = "its header has no stamp"
            return None
        when, now = self.to_link_time(stamp), self.now()
        if abs(now - when) > self._config.feedback_timeout:
            self._problem = (
                f"its stamps are {abs(now - when):.2f} s {'behind' if now > when else 'ahead of'} "
                f"{'/clock' if self._sim_time else 'the clock of this computer'}"
            )
            return None
        return when

    def _take_speeds(self, when: float, speeds: Speeds) -> None:
        if (encoders := self._config.wheels.encoders) is not None:
            speeds = encoders.to_wire(speeds)
        line = ",".join(
            f"{letter}{'p' if speed >= 0.0 else 'n'}{abs(speed):09.6f}"
            for letter, speed in zip("abcd", speeds, strict=True)
        )
        self._pending.append((when, f"{line}\r\n".encode()))
        self._newest, self._heard, self._problem = when, self.now(), ""
        self.delays.append(self._heard - when)

    def _on_command(self, message: Any) -> None:
        """Find commands of other nodes among those that the robot gets."""
        self._echoed += 1
        content = read_command(message)
        if content in self._sent:
            return
        since = self._driving_since
        late = since is not None and time.monotonic() - since > OTHERS_GRACE
        if any(content[-1]) or (late and not self.watchdog.has_tripped):
            self._intruded = True

    # What is sent

    def write(self, data: bytes) -> None:
        """Publish the newest command of whole lines; zero commands are always sent.

        Raises:
            LinkError: wheels would turn, but the watchdog stopped the robot or doesn't run, or
                the program is ending, or was asked to; zeros are sent instead.
        """
        readings = self._commands.feed(data)
        with self._lock:
            self._require_node()
            if not readings:
                return
            speeds = readings[-1].over(ZERO)
            if (motors := self._config.wheels.motors) is not None:  # letters of a board's wire
                speeds = Reading(motors.to_wheels(speeds)).over(ZERO)
            if not any(speeds):
                self._stop()
                return
            try:
                self.watchdog.allow_drive()
                check_may_drive()  # last, as a signal may come at any time
                self._publish(speeds)
                self.watchdog.note_drive()
            except BaseException:
                self._publish(ZERO)
                raise
            if self._driving_since is None:
                self._driving_since = time.monotonic()

    def _stop(self) -> None:
        """Publish zeros, and tell the watchdog."""
        self._publish(ZERO)
        self._driving_since = None
        self.watchdog.note_stop()

    def _publish(self, speeds: Speeds) -> None:
        """Publish wheel speeds [rad/s] as what the robot takes."""
        node, command = self.node, self._command
        if node is None:
            return
        a, b, c, d = speeds
        if self._kind == "wheel_speeds":
            joints = self._config.ros_joints
            if self._config.has_two_wheels:
                speeds = ((a + d) / 2.0, (b + c) / 2.0, (b + c) / 2.0, (a + d) / 2.0)
            wheels = dict(zip(joints, speeds, strict=True))
            command.data = [wheels[name] for name in self._config.ros2.command_joints or joints]
        else:
            stamped = self._kind == "twist_stamped"
            twist = command.twist if stamped else command
            twist.linear.x, twist.angular.z = kinematics.compute_twist(a, b, c, d, *self._geometry)
            if stamped:
                # A controller refuses old commands, and /clock is as old as the last spin: a zero
                # says 0, which means now.
                is_stale = time.monotonic() - self._clock_moved > CLOCK_PAUSE
                is_timeless = self._sim_time and (is_stale or not any(speeds))
                command.header.stamp = make_stamp(node.ros, 0 if is_timeless else node.now())
        self._sent.append(read_command(command))
        self._publisher.publish(command)

    # The contract

    def reset(self, scene: Scene) -> None:
        """Command zero, put a simulated robot into the scene, and restart the deadlines.

        After the watchdog stopped the robot, this allows driving again.
        """
        node = self._require_node()
        with self._lock:
            self._stop()
        check_may_start()
        try:
            with self._lock:
                restart = self.watchdog.is_started and not self.watchdog.is_alive
                if restart:
                    self.watchdog.close()
                    self._start_watchdog(node)
            if restart:
                self.watchdog.wait_ready(WATCHDOG_START)
            if self.places_robot:
                self._reset_simulation(node, scene)
            with self._lock:
                self.watchdog.rearm()
        except BaseException:  # don't drive without a watchdog
            self.close()
            raise
        node.wait_until(lambda: False, DRAIN_TIMEOUT, self._poll)  # what came while nobody spun
        self._intruded = False
        self._pending = []
        self._heard = self._deadline = self.now()
        self.lateness = 0.0

    def _reset_simulation(self, node: RosNode, scene: Scene) -> None:
        """Put a simulated robot of `acsar-gym ros driver` into a scene, if there is one."""
        prefix = f"{self._namespace.rstrip('/')}/{DRIVER_NODE}"
        services = {name for name, _ in node.node.get_service_names_and_types()}
        if f"{prefix}/reset" not in services:
            return
        ros = node.ros
        request = ros.SetParameters.Request()
        parameter = ros.parameter.Parameter
        text = parameter(SCENE_PARAMETER, parameter.Type.STRING, format_scene(scene))
        request.parameters = [text.to_parameter_msg()]
        self._call(node, ros.SetParameters, f"{prefix}/set_parameters", request)
        answer = self._call(node, ros.Trigger, f"{prefix}/reset", ros.Trigger.Request())
        if not answer.success:
            raise LinkError(f"{prefix}/reset: {answer.message}", "see what its driver prints")

    def _call(self, node: RosNode, kind: Any, name: str, request: Any) -> Any:
        """Call a service, and wait for its answer."""
        client = node.node.create_client(kind, name)
        future = client.call_async(request)
        try:
            if not node.wait_until(future.done, RESET_TIMEOUT, self._poll):
                raise LinkError(f"{name}: no answer in {RESET_TIMEOUT:g} s", "is its node alive?")
            return future.result()
        finally:
            node.node.destroy_client(client)

    def _poll(self) -> None:
        WHILE_WAITING.get()()
        self._beat()

    def advance(self, period: float) -> bytes:
        """Spin until the absolute deadline of the period [s]; return lines of what has arrived.

        The deadlines' phase follows the joint states. After a delay of more than a period they
        restart from now.

        Raises:
            LinkError: the robot is silent, somebody else commands it, or the clock jumped back.
        """
        node = self._require_node()
        self._catch_up(node)
        self._deadline += period
        while True:
            now, handled = self._check_clock(), self._handled + self._echoed
            node.spin(min(self._deadline - now, self.watchdog.beat_interval, period))
            self._beat()
            before, now = now, self.now()
            jumped = self._sim_time and now != before
            idle = handled == self._handled + self._echoed and not jumped
            if idle and self._deadline - now <= CLOCK_STEP:
                break
        self.lateness = now - self._deadline
        if self.lateness > period:
            self._deadline = now
        self._arrivals, self._pending = self._pending, []
        if self._arrivals and not self._sim_time:
            self._follow_phase(self._heard - self._deadline, period)
        if self._intruded:
            others = self._list_others(node)
            raise LinkError(
                f"{node.resolve(self._config.ros2.command_topic)}: somebody else commands the "
                f"robot, too ({', '.join(others) or 'a node that has ended'})",
                "end that, or let a twist_mux choose, then reset",
            )
        if now - self._heard > self._config.feedback_timeout:
            raise self._silence_error(now - self._heard)
        return b"".join([line for _, line in self._arrivals])

    def _catch_up(self, node: RosNode) -> None:
        """Hear the simulated time again after a pause in which nothing spun.

        For the node it stood still, too, so that what waits seems to be of the future.
        """
        if not self._sim_time or time.monotonic() - self._clock_moved < CLOCK_PAUSE:
            return
        before = self.now()
        node.wait_until(lambda: self.now() != before, CLOCK_TIMEOUT, self._poll)
        self._clock_moved, self._heard = time.monotonic(), self.now()
        node.wait_until(lambda: self._pending, self._config.feedback_timeout, self._poll)

    def idle(self, duration: float) -> None:
        """Let time pass without commands [s], as between two goals; others may drive meanwhile.

        What arrives is forgotten.

        Raises:
            LinkError: the robot is silent, or the clock jumped back.
        """
        node = self._require_node()
        self._catch_up(node)
        heard, end = self._heard, self.now() + duration
        while (remaining := end - self._check_clock()) > CLOCK_STEP:
            node.spin(min(remaining, self.watchdog.beat_interval))
            self._beat()
        self._arrivals, self._pending, self._intruded = [], [], False
        # Messages that waited while nobody spun are old, and say nothing about silence.
        self._quiet = 0.0 if self._heard > heard else self._quiet + duration
        if self._quiet > self._config.feedback_timeout:
            raise self._silence_error(self._quiet)

    def _follow_phase(self, arrived: float, period: float) -> None:
        """Move the deadlines towards `SLACK` after the arrivals, which is before the deadline."""
        error = (arrived + SLACK + period / 2.0) % period - period / 2.0
        most = PHASE_SHARE * period
        self._deadline += min(max(PHASE_GAIN * error, -most), most)

    def _check_clock(self) -> float:
        """Return the link's time [s]; LinkError where it jumped back, or stands still."""
        now, real = self.now(), time.monotonic()
        before, self._now_before = self._now_before, now
        if now != before:
            self._clock_moved = real
        source = "/clock" if self._sim_time else "the clock of this computer"
        if now < before:
            raise LinkError(f"{self.device}: {source} jumped back by {before - now:.3f} s", "reset")
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

    def _beat(self) -> None:
        with self._lock:
            self.watchdog.beat()

    def now(self) -> float:
        """Return the time of the node's clock since the opening [s]; 0 before."""
        return self.to_link_time(self.node.now()) if self.node is not None else 0.0

    def ros_time(self) -> int:
        """Return the time of ROS [ns]; 0 while closed."""
        return self.node.now() if self.node is not None else 0

    def close(self) -> None:
        """Command zero, wait until the robot has it, and end the node. Idempotent."""
        with self._lock:
            node = self.node
            if node is None:
                return
            try:
                self._send_stop()
            except BaseException:
                self._send_stop()
                raise
            finally:
                with contextlib.ExitStack() as last_to_first:
                    last_to_first.callback(self._let_go, node)
                    last_to_first.callback(self.watchdog.close)

    def _send_stop(self) -> None:
        """Publish zeros, and wait until they were received."""
        if self._publisher is not None and self.node is not None:
            with contextlib.suppress(Exception):  # of rclpy, whose context may be shut down
                self._publish(ZERO)
                self._publisher.wait_for_all_acked(self.node.make_duration(DRAIN_TIMEOUT))

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Command zero, and lock out commands of other threads, as a context manager."""
        with self._lock:
            self._send_stop()
            yield

    def _let_go(self, node: RosNode) -> None:
        self.node = self._publisher = None
        forget_link(self)
        node.close()

    def abandon(self) -> None:
        """Forget the node without sending anything, for a forked child, which can't use it."""
        self._make_locks()
        if self.node is not None:
            self.watchdog.abandon()
            self.node = self._publisher = None
            forget_link(self)

    def __del__(self) -> None:
        if getattr(self, "node", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[type[Ros2Link], tuple[object, ...]]:
        """Copy and pickle as a closed link to the same robot."""
        return Ros2Link, (self.device, self._config)

    def _require_node(self) -> RosNode:
        if self.node is None:
            raise LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")
        return self.node


def read_command(message: Any) -> tuple[Any, ...]:
    """Return what tells a command from others, and last its numbers."""
    if hasattr(message, "data"):
        return (tuple(message.data),)
    if hasattr(message, "header"):
        twist = message.twist
        return read_stamp(message.header.stamp), (twist.linear.x, twist.angular.z)
    return ((message.linear.x, message.angular.z),)


def format_scene(scene: Scene) -> str:
    """Return a scene as JSON, for the parameter `scene` of a simulated robot's driver."""
    world = None if scene.world is None else json.loads(format_world(scene.world, ".json"))
    return json.dumps({"start": scene.start, "goal": scene.goal, "world": world})
