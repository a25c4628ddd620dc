"""The topics of a recording: names, ROS 2 types, and the columns of those that are tables."""

from __future__ import annotations

from dataclasses import dataclass

ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"
BASE_FOOTPRINT = "base_footprint"
"""Frame on the ground below the base frame; odometry moves it."""
LATCHED = """- history: 3
  depth: 0
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
"""Quality of service for topics whose newest message late listeners get, as rosbag2 writes it."""

EXCHANGE_COLUMNS = (
    *("number", "stamp", "writes", "pieces", "lateness", "true_x", "true_y", "true_theta"),
    *("true_linear", "true_angular", "true_contact"),
)
"""One row for each control period of the wire: its number in the episode, its end on the link's
clock [s], how many writes (/wire/sent) and pieces (/wire/received) belong to it, how long after its
deadline it ended [s], and the ground truth in the frame of the world; NaN where unknown."""
TICK_COLUMNS = (
    *("exchange", "stamp", "x", "y", "theta", "linear", "angular"),
    *("speed_a", "speed_b", "speed_c", "speed_d", "angle_a", "angle_b", "angle_c", "angle_d"),
    *("asked_linear", "asked_angular", "sent_linear", "sent_angular", "reason"),
    *("lateness", "feedback_age", "refused"),
)
"""One row for each tick of the robot: odometry, wheels, commands, and the safety layer's reason."""
STEP_COLUMNS = ("step", "stamp", "reward", "terminated", "truncated", "success")
"""One row for each step of the env; step 0 is the reset, without action and reward."""
SCAN_COLUMNS = ("exchange", "stamp", "ranges")
"""One row for each scan: the exchange at whose end it was the newest, the end of its revolution
[s], and its ranges [m], exactly as the policy got them."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording."""

    name: str
    kind: str
    """Type, such as "nav_msgs/msg/Odometry"."""
    columns: tuple[str, ...] = ()
    latched: bool = False

    @property
    def metadata(self) -> dict[str, str]:
        """What its channel tells besides."""
        told = {"offered_qos_profiles": LATCHED if self.latched else ""}
        return told | ({"columns": ",".join(self.columns)} if self.columns else {})


FLOATS = "std_msgs/msg/Float64MultiArray"
SINGLES = "std_msgs/msg/Float32MultiArray"
BYTES = "std_msgs/msg/UInt8MultiArray"

ODOM = Topic("/odom", "nav_msgs/msg/Odometry")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage")
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
JOINT_STATES = Topic("/joint_states", "sensor_msgs/msg/JointState")
CMD_VEL = Topic("/cmd_vel", "geometry_msgs/msg/Twist")
CMD_VEL_SENT = Topic("/cmd_vel_sent", "geometry_msgs/msg/Twist")
SCAN = Topic("/scan", "sensor_msgs/msg/LaserScan")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
TRUTH = Topic("/truth", "nav_msgs/msg/Odometry")
TIME_REFERENCE = Topic("/time_reference", "sensor_msgs/msg/TimeReference")
WIRE_SENT = Topic("/wire/sent", BYTES)
WIRE_RECEIVED = Topic("/wire/received", BYTES)
OBSERVATION = Topic("/observation", SINGLES)
ACTION = Topic("/action", SINGLES)
EPISODE = Topic("/acsar/episode", "std_msgs/msg/String", latched=True)
EXCHANGES = Topic("/acsar/exchanges", FLOATS, EXCHANGE_COLUMNS)
TICKS = Topic("/acsar/ticks", FLOATS, TICK_COLUMNS)
STEPS = Topic("/acsar/steps", FLOATS, STEP_COLUMNS)
SCANS = Topic("/acsar/scans", FLOATS, SCAN_COLUMNS)

TOPICS = (
    *(ODOM, TF, TF_STATIC, JOINT_STATES, CMD_VEL, CMD_VEL_SENT, SCAN, DIAGNOSTICS, TRUTH),
    *(TIME_REFERENCE, WIRE_SENT, WIRE_RECEIVED, OBSERVATION, ACTION),
    *(EPISODE, EXCHANGES, TICKS, STEPS, SCANS),
)
"""All of them; those under /acsar are what this project reads back, bit for bit."""
