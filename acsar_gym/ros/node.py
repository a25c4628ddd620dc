"""The only file that imports rclpy: a node with its own executor and context.

ROS 2 isn't installed by pip. It comes with a system, and if it is missing, one line reports it.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from types import FrameType, SimpleNamespace
from typing import Any

from acsar_gym.errors import AcsarError, escape_unprintable

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
"""Types of messages that command wheels, by their names in a robot's file, the best first."""
WATCHDOG_SUFFIX = "_watchdog"
"""End of the name of a watchdog's node, which publishes nothing but zeros."""
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Name of a node that ROS has just discovered, such as our watchdog's."""
SPIN_PERIOD = 0.1
"""How soon threads notice that they must end [s]."""
CLOCK_GAP = 1e7
"""Wall-clock time and simulated time differ by more than this [s]: four months."""
TRANSPORTS = ("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
"""Environment variable of Fast DDS, and its default in this program. A process that is killed or
stopped may leave the shared memory of the other transport locked, which blocks the robot's node."""
ROS_ARGUMENTS: ContextVar[Sequence[str]] = ContextVar("ros_arguments", default=())
"""Arguments (what follows --ros-args) of nodes that aren't given any, such as a link's."""


class MissingRosError(AcsarError):
    """ROS 2 isn't installed, or not in this Python.

    Args:
        reason: Why it can't be imported.
    """

    exit_code = 2

    def __init__(self, reason: str) -> None:
        super().__init__(f"ROS 2 can't be used here ({reason}): {MISSING_ROS}")


_SOURCE_PLACE = re.compile(r",? at \S+:\d+")
"""Place in ROS's sources where an error was raised."""


class RosSetupError(AcsarError):
    """A node can't be made, for example because ROS doesn't allow its name, or it has failed."""

    exit_code = 2

    def __init__(self, name: str, namespace: str, error: Exception) -> None:
        reason = _SOURCE_PLACE.sub("", " ".join(str(error).split()))[:300]
        if type(error).__name__ == "UnknownROSArgsError":
            reason = f"unknown arguments of ROS: {reason}"
        super().__init__(f"ROS node {namespace.rstrip('/')}/{name}: {reason}")


def load_ros() -> SimpleNamespace:
    """Import rclpy and the messages that this package uses.

    Returns:
        Classes and functions, by their names in ROS. `TFMessage` is None if tf2_msgs is missing.

    Raises:
        MissingRosError: Another package is missing.
    """
    try:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
        from geometry_msgs.msg import PoseStamped, TransformStamped, Twist, TwistStamped
        from nav_msgs.msg import Odometry, Path
        from rcl_interfaces.msg import ParameterDescriptor
        from rcl_interfaces.srv import SetParameters
        from rclpy import init, logging, parameter, qos
        from rclpy.context import Context
        from rclpy.duration import Duration
        from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import JointState, LaserScan
        from std_msgs.msg import Float64MultiArray
        from std_srvs.srv import Trigger
    except ImportError as error:
        raise MissingRosError(" ".join(str(error).split())) from error

    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        TFMessage = None  # noqa: N806 - a class
    return SimpleNamespace(**locals())


class RosNode:
    """A node with its own context and executor, so that no other node ends it.

    Signals are left to the program. A forked child must not use any of it.

    Args:
        name: Name of the node.
        namespace: Namespace of the node, such as "/robot1".
        arguments: Arguments of ROS, which follow "--ros-args". Those of `ROS_ARGUMENTS` if empty.
        parameters: Parameters to declare, with their defaults.
        overrides: Values of parameters that have precedence over those of `arguments`.
        services: Whether other nodes may read and set its parameters.

    Attributes:
        ros: The namespace that `load_ros` returns.
        node: The rclpy.node.Node.
        problem: Incompatibility that the middleware reported, in words. Empty if there is none.

    Raises:
        MissingRosError: ROS 2 isn't installed.
        RosSetupError: ROS refuses the name or the arguments.
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
        # Fast DDS reads it when the context is made.
        os.environ.setdefault(*TRANSPORTS)
        self.ros = ros = load_ros()
        self.problem = ""
        self._context = ros.Context()
        words = list(arguments or ROS_ARGUMENTS.get())
        try:
            # The exception reports wrong arguments, so that the log needn't.
            ros.logging.set_logger_level("rcl", ros.logging.LoggingSeverity.FATAL)
            ros.init(
                args=["--ros-args", *words] if words else None,
                context=self._context,
                signal_handler_options=ros.SignalHandlerOptions.NO,
            )
            ros.logging.set_logger_level("rcl", ros.logging.LoggingSeverity.UNSET)

            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # repeats the exception
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
        self._threads: list[threading.Thread] = []
        self._running = True
        self._failure: Exception | None = None
        self.declare(parameters or {})
        # Each node has its own executor, so that several links can spin in one process.
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

    def declare(self, parameters: dict[str, Any], changeable: Sequence[str] = ()) -> None:
        """Declare parameters with their defaults. Only changeable ones can be set later."""
        for name, value in parameters.items():
            if not self.node.has_parameter(name):  # the arguments don't contain it
                self.node.declare_parameter(name, value)
            is_fixed = name not in changeable
            descriptor = self.ros.ParameterDescriptor(dynamic_typing=True, read_only=is_fixed)
            self.node.set_descriptor(name, descriptor)

    def list_parameters(self) -> list[str]:
        """List the names of all parameters, including those of the arguments."""
        return list(self.node.list_parameters([], 0).names)

    def read_parameter(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.node.get_parameter(name).value

    def say(self, text: str) -> None:
        """Log a line about a success."""
        self.node.get_logger().info(escape_unprintable(text))

    def warn(self, text: str) -> None:
        """Log a line about a problem."""
        self.node.get_logger().warning(escape_unprintable(text))

    def publish(self, topic: str, kind: Any, depth: int = 1, *, latched: bool = False) -> Any:
        """Make a publisher, which is reliable."""
        return self.node.create_publisher(
            kind,
            topic,
            self._make_qos(depth, latched=latched),
            event_callbacks=self._watch_qos(topic, self.ros.PublisherEventCallbacks),
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
        """Make a subscription. Its callback takes the message, or the message and its info."""
        return self.node.create_subscription(
            kind,
            topic,
            callback,
            self._make_qos(depth, best_effort=best_effort, latched=latched),
            event_callbacks=self._watch_qos(topic, self.ros.SubscriptionEventCallbacks),
        )

    def subscribe_transforms(
        self, callback: Callable[[Any], None], *, moving: bool = True, namespace: str = ""
    ) -> bool:
        """Subscribe /tf_static and, if `moving`, /tf, and the topics of a namespace likewise.

        Args:
            callback: Takes a tf2_msgs/TFMessage.
            moving: Whether /tf is needed.
            namespace: Namespace with its own transforms (Clearpath, TurtleBot 4). By default that
                of the node.

        Returns:
            Whether tf2_msgs is installed. If not, nothing is subscribed.
        """
        kind = self.ros.TFMessage
        if kind is None:
            return False

        # Several robots may each have their own tree of transforms.
        for prefix in dict.fromkeys(("", (namespace or self.namespace).rstrip("/"))):
            self.subscribe(f"{prefix}/tf_static", kind, callback, depth=100, latched=True)
            if moving:
                self.subscribe(f"{prefix}/tf", kind, callback, depth=100)
        return True

    def _make_qos(self, depth: int, *, best_effort: bool = False, latched: bool = False) -> Any:
        """Return a QoS profile that keeps the last `depth` messages."""
        # Best-effort subscriptions match all publishers, reliable publishers all subscriptions.
        reliability = self.ros.qos.ReliabilityPolicy
        durability = self.ros.qos.DurabilityPolicy
        return self.ros.qos.QoSProfile(
            depth=depth,
            reliability=reliability.BEST_EFFORT if best_effort else reliability.RELIABLE,
            durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        )

    def _watch_qos(self, topic: str, kind: Any) -> Any:
        """Return callbacks that store an incompatibility in `problem`."""

        def note_problem(event: Any) -> None:
            policy = self.ros.qos.QoSPolicyKind(event.last_policy_kind).name.lower()
            self.problem = f"{self.resolve(topic)}: incompatible QoS ({policy})"

        return kind(incompatible_qos=note_problem, use_default_callbacks=False)

    def resolve(self, topic: str) -> str:
        """Return the full name of a topic."""
        return str(self.node.resolve_topic_name(topic))

    def list_subscribed_types(self, topic: str) -> set[str]:
        """List the types with which a topic is subscribed."""
        subscriptions = self.node.get_subscriptions_info_by_topic(self.resolve(topic))
        return {subscription.topic_type for subscription in subscriptions}

    def list_publishers(self, topic: str) -> list[str]:
        """List the full names of the nodes that publish a topic, one for each publisher."""
        publishers = self.node.get_publishers_info_by_topic(self.resolve(topic))
        return [f"{peer.node_namespace.rstrip('/')}/{peer.node_name}" for peer in publishers]

    def list_commanders(self, topic: str) -> list[str]:
        """List the nodes that publish a topic, without this node and watchdogs."""
        # A watchdog commands nothing but zeros.
        ignored = (WATCHDOG_SUFFIX, UNKNOWN_NODE)
        own_name = f"{self.namespace.rstrip('/')}/{self.name}"
        names = self.list_publishers(topic)
        return [name for name in names if name != own_name and not name.endswith(ignored)]

    def has_nameless_publisher(self, topic: str) -> bool:
        """Whether a topic has a publisher whose node isn't known yet."""
        return any(name.endswith(UNKNOWN_NODE) for name in self.list_publishers(topic))

    def use_sim_time(self) -> None:
        """Take the time from /clock from now on."""
        # The arguments of the node may contain it.
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
        """Handle messages that have arrived, or the first that arrives within a time [s]."""
        with interrupts_deferred():
            self._executor.spin_once(timeout_sec=max(timeout, 0.0))

    def wait_until(
        self, condition: Callable[[], Any], timeout: float, poll: Callable[[], None] = lambda: None
    ) -> bool:
        """Spin until a condition holds. Return whether it does within a time [s]."""
        # By the real clock, as a simulated one may stand still.
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() >= deadline:
                return False
            poll()
            self.spin(0.02)
        return True

    def start_threads(self, *loops: Callable[[], None]) -> None:
        """Repeat each function in a thread of its own until the node is closed."""
        for loop in loops:
            thread = threading.Thread(target=self._repeat, args=(loop,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _repeat(self, loop: Callable[[], None]) -> None:
        try:
            while self._running:
                loop()
        except Exception as error:  # noqa: BLE001 - any error is for the main thread
            self._failure = error

    def check(self) -> None:
        """Raise RosSetupError if a thread has failed."""
        if self._failure is not None:
            raise RosSetupError(self.name, self.namespace, self._failure) from self._failure

    def close(self) -> None:
        """End threads, node and context. Idempotent."""
        # A thread that hangs in rclpy isn't waited for.
        self._running = False
        for thread in self._threads:
            thread.join(2.0 * SPIN_PERIOD)
        with contextlib.suppress(Exception):
            self._executor.shutdown(timeout_sec=0.0)
        with contextlib.suppress(Exception):
            self.node.destroy_node()
        with contextlib.suppress(Exception):
            self._context.try_shutdown()


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Call the handler of SIGINT after the block instead of inside it.

    rclpy swallows a KeyboardInterrupt in `Future.__del__`, and turns it into other errors in C++.
    """
    # Only the main thread may change handlers, and only a callable handler can be called later.
    handler = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if not (is_main and callable(handler)):
        yield
        return
    # Signals wait until rclpy has returned.
    interrupts: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: interrupts.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        for interrupt in interrupts:
            handler(*interrupt)


def make_stamp(ros: SimpleNamespace, nanoseconds: int) -> Any:
    """Return a builtin_interfaces/Time."""
    stamp = ros.Clock().clock
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)
    return stamp


def read_stamp(stamp: Any) -> int:
    """Return a builtin_interfaces/Time in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def explain_age(age: float, *, simulated: bool) -> str:
    """Explain why a message's stamp doesn't fit the clock.

    Args:
        age: Time of the clock minus the stamp [s].
        simulated: Whether the clock is /clock.
    """
    # Simulated clocks start at zero.
    if abs(age) > CLOCK_GAP:
        return f"is of another clock: set use_sim_time: {str(simulated).lower()} in its publisher"
    clock = "/clock" if simulated else "the clock of this computer"
    return f"is {abs(age):.2f} s {'behind' if age > 0.0 else 'ahead of'} {clock}"


def make_command(ros: SimpleNamespace, kind: str, frame: str = "") -> Any:
    """Return a message of one of `COMMAND_KINDS` that commands zero."""
    if kind == "wheel_speeds":
        return ros.Float64MultiArray(data=[0.0] * 4)
    if kind == "twist":
        return ros.Twist()
    command = ros.TwistStamped()
    command.header.frame_id = frame
    return command


def child_environment() -> dict[str, str]:
    """Return the environment of a process that must find everything this process has imported."""
    # Paths relative to this folder would be wrong in another.
    folders = [os.path.abspath(folder) for folder in sys.path]  # noqa: PTH100
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders)}
