"""The one file that imports rclpy: nodes with an executor and a context of their own.

ROS 2 isn't installed by pip, but comes with a system; where it is missing, one line says so.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from acsar_gym.errors import AcsarError

MISSING_ROS = (
    "source /opt/ros/DISTRO/setup.bash in this terminal, and use an environment that was made with "
    "python3 -m venv --system-site-packages"
)
NANOSECONDS = 1_000_000_000
COMMAND_KINDS = {
    "twist_stamped": "geometry_msgs/msg/TwistStamped",
    "twist": "geometry_msgs/msg/Twist",
    "wheel_speeds": "std_msgs/msg/Float64MultiArray",
}
"""Types of messages that command wheels, by their names in a robot's file, the preferred first."""


class MissingRosError(AcsarError):
    """ROS 2 isn't installed, or not in this Python.

    Args:
        reason: why it can't be imported.
    """

    exit_code = 2

    def __init__(self, reason: str) -> None:
        super().__init__(f"ROS 2 can't be used here ({reason}): {MISSING_ROS}")


def load_ros() -> SimpleNamespace:
    """Import rclpy and the messages that this package uses.

    Returns:
        Classes and functions, by their names in ROS; `TFMessage` is None where tf2_msgs is missing.

    Raises:
        MissingRosError: something else is missing.
    """
    try:
        from diagnostic_msgs.msg import (
            DiagnosticArray,
            DiagnosticStatus,
            KeyValue,
        )
        from geometry_msgs.msg import (
            Point,
            PoseStamped,
            TransformStamped,
            Twist,
            TwistStamped,
        )
        from nav_msgs.msg import Odometry, Path
        from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
        from rcl_interfaces.srv import SetParameters
        from rclpy import init, logging, parameter, qos
        from rclpy.context import Context
        from rclpy.duration import Duration
        from rclpy.event_handler import (
            PublisherEventCallbacks,
            SubscriptionEventCallbacks,
        )
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import JointState, LaserScan
        from std_msgs.msg import Float64MultiArray
        from std_srvs.srv import Trigger
        from visualization_msgs.msg import Marker, MarkerArray
    except ImportError as error:
        raise MissingRosError(" ".join(str(error).split())) from error
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        TFMessage = None  # noqa: N806 - a class
    return SimpleNamespace(**locals())


class RosNode:
    """A node, with a context and an executor of its own, so that others don't end it.

    Signals are left to the program. Nothing of it may be used in a forked child.

    Attributes: `ros`, what `load_ros` returns; `node`, the rclpy.node.Node; `problem`, an
    incompatibility that the middleware reported, in words, or empty.

    Args:
        name: of the node.
        namespace: of the node, such as "/robot1".
        arguments: ROS's own, after "--ros-args".
        parameters: to declare, by name, with their defaults.
        overrides: values of parameters that count more than those of ROS's arguments.
        services: whether others may read and set its parameters.
    """

    def __init__(
        self,
        name: str,
        namespace: str = "",
        arguments: Sequence[str] = (),
        parameters: dict[str, Any] | None = None,
        *,
        overrides: dict[str, Any] | None = None,
        services: bool = False,
    ) -> None:
        self.ros = ros = load_ros()
        self.problem = ""
        self._context = ros.Context()
        given = ["--ros-args", *arguments] if arguments else None
        try:
            # What is wrong with the arguments is said by the exception, too.
            ros.logging.set_logger_level("rcl", ros.logging.LoggingSeverity.FATAL)
            ros.init(
                args=given,
                context=self._context,
                signal_handler_options=ros.SignalHandlerOptions.NO,
            )
            ros.logging.set_logger_level("rcl", ros.logging.LoggingSeverity.UNSET)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # beside the error that says why
                self.node = ros.Node(
                    name,
                    namespace=namespace or None,
                    context=self._context,
                    start_parameter_services=services,
                    enable_rosout=services,
                    automatically_declare_parameters_from_overrides=True,
                    parameter_overrides=[
                        ros.parameter.Parameter(key, value=value)
                        for key, value in (overrides or {}).items()
                    ],
                )
        except Exception as error:  # rclpy has a dozen kinds
            with contextlib.suppress(Exception):
                self._context.try_shutdown()
            raise RosSetupError(name, namespace, error) from error
        self.declare(parameters or {})
        self._executor = ros.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    @property
    def name(self) -> str:
        """Name of the node."""
        return str(self.node.get_name())

    @property
    def namespace(self) -> str:
        """Namespace of the node."""
        return str(self.node.get_namespace())

    def declare(self, parameters: dict[str, Any], *, fixed: bool = True) -> None:
        """Declare parameters with their defaults; nobody can change those that are fixed."""
        descriptor = self.ros.ParameterDescriptor(dynamic_typing=True, read_only=fixed)
        for name, value in parameters.items():
            if not self.node.has_parameter(name):  # ROS's arguments don't give it
                self.node.declare_parameter(name, value)
            self.node.set_descriptor(name, descriptor)

    def list_parameters(self) -> list[str]:
        """List the names of all parameters, those that ROS's arguments give included."""
        return list(self.node.list_parameters([], 0).names)

    def read_parameter(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.node.get_parameter(name).value

    def publish(self, topic: str, kind: Any, depth: int = 1, *, latched: bool = False) -> Any:
        """Make a publisher, which is reliable."""
        return self.node.create_publisher(
            kind,
            topic,
            self.make_qos(depth, latched=latched),
            event_callbacks=self.ros.PublisherEventCallbacks(
                incompatible_qos=lambda event: self._note_problem(topic, event),
                use_default_callbacks=False,
            ),
        )

    def subscribe(
        self,
        topic: str,
        kind: Any,
        callback: Callable[..., None],
        depth: int = 1,
        *,
        best_effort: bool = False,
        latched: bool = False,
    ) -> Any:
        """Make a subscription, whose callback takes the message, or message and message info."""
        return self.node.create_subscription(
            kind,
            topic,
            callback,
            self.make_qos(depth, best_effort=best_effort, latched=latched),
            event_callbacks=self.ros.SubscriptionEventCallbacks(
                incompatible_qos=lambda event: self._note_problem(topic, event),
                use_default_callbacks=False,
            ),
        )

    def make_qos(self, depth: int, *, best_effort: bool = False, latched: bool = False) -> Any:
        """Return a QoS profile that keeps the last `depth` messages."""
        qos = self.ros.qos
        reliability, durability = qos.ReliabilityPolicy, qos.DurabilityPolicy
        return qos.QoSProfile(
            depth=depth,
            reliability=reliability.BEST_EFFORT if best_effort else reliability.RELIABLE,
            durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        )

    def _note_problem(self, topic: str, event: Any) -> None:
        policy = self.ros.qos.QoSPolicyKind(event.last_policy_kind).name.lower()
        self.problem = f"{self.resolve(topic)}: incompatible QoS ({policy})"

    def resolve(self, topic: str) -> str:
        """Return the full name of a topic."""
        return str(self.node.resolve_topic_name(topic))

    def list_peers(self, topic: str, *, publishers: bool) -> list[tuple[str, str]]:
        """List the nodes that publish a topic, or subscribe it: full name of the node, and type."""
        name = self.resolve(topic)
        if publishers:
            peers = self.node.get_publishers_info_by_topic(name)
        else:
            peers = self.node.get_subscriptions_info_by_topic(name)
        return [
            (f"{peer.node_namespace.rstrip('/')}/{peer.node_name}", peer.topic_type)
            for peer in peers
        ]

    def use_sim_time(self) -> None:
        """Take the time from /clock from now on."""
        parameter = self.ros.parameter.Parameter
        if not self.node.has_parameter("use_sim_time"):
            self.node.declare_parameter("use_sim_time", value=False)
        self.node.set_parameters([parameter("use_sim_time", parameter.Type.BOOL, value=True)])

    def now(self) -> int:
        """Return the time of the node's clock [ns]."""
        return int(self.node.get_clock().now().nanoseconds)

    def make_duration(self, seconds: float) -> Any:
        """Return a rclpy.duration.Duration."""
        return self.ros.Duration(nanoseconds=round(seconds * NANOSECONDS))

    def spin(self, timeout: float) -> None:
        """Handle what has arrived, or the first that arrives within a time [s]."""
        self._executor.spin_once(timeout_sec=max(timeout, 0.0))

    def wait_until(
        self, condition: Callable[[], Any], timeout: float, poll: Callable[[], None] = lambda: None
    ) -> bool:
        """Spin until a condition holds; whether it does within a time [s]."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() >= deadline:
                return False
            poll()
            self.spin(0.02)
        return True

    def close(self) -> None:
        """End node and context. Idempotent."""
        with contextlib.suppress(Exception):
            self._executor.shutdown(timeout_sec=0.0)
        with contextlib.suppress(Exception):
            self.node.destroy_node()
        with contextlib.suppress(Exception):
            self._context.try_shutdown()


_PLACE = re.compile(r",? at \S+:\d+")
"""Where in ROS's sources an error was raised."""


class RosSetupError(AcsarError):
    """A node that can't be made, as for a name that ROS doesn't allow, or has failed."""

    exit_code = 2

    def __init__(self, name: str, namespace: str, error: Exception) -> None:
        why = _PLACE.sub("", " ".join(str(error).split()))[:300]
        if type(error).__name__ == "UnknownROSArgsError":
            why = f"unknown arguments of ROS: {why}"
        super().__init__(f"ROS node {namespace.rstrip('/')}/{name}: {why}")


def make_stamp(ros: SimpleNamespace, nanoseconds: int) -> Any:
    """Return a builtin_interfaces/Time."""
    stamp = ros.Clock().clock
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)
    return stamp


def read_stamp(stamp: Any) -> int:
    """Return a builtin_interfaces/Time in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def child_environment() -> dict[str, str]:
    """Return the environment of a process that must find what this one has imported."""
    folders = [os.path.abspath(folder) for folder in sys.path]  # noqa: PTH100
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders)}


def make_command(ros: SimpleNamespace, kind: str, frame: str = "") -> Any:
    """Return a message of one of `COMMAND_KINDS` that commands zero, to be filled."""
    if kind == "wheel_speeds":
        return ros.Float64MultiArray(data=[0.0] * 4)
    if kind == "twist":
        return ros.Twist()
    command = ros.TwistStamped()
    command.header.frame_id = frame
    return command
