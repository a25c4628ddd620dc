"""A LiDAR in ROS 2: its scans, and its pose from /tf_static or the robot's file."""

from __future__ import annotations

from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, show_value
from acsar_gym.lidar.contract import check_age
from acsar_gym.lidar.laser_scan import LaserScan, Mount, read_mount, read_scan
from acsar_gym.lidar.scan import Revolution
from acsar_gym.links.base import WHILE_WAITING, Link
from acsar_gym.ros.node import NANOSECONDS, RosNode, read_stamp
from acsar_gym.worlds import Scene

SCAN_DEPTH = 5  # scans that wait while a program doesn't step
STATIC_TIMEOUT = 1.0
"""Longest wait for a transform if the robot's file has `lidar_yaw`: nodes find each other within
this time [s]."""


class RosLidar:
    """The scans of a topic, received by the node of the robot's link, or by a separate node.

    Attributes:
        topic: Name of the topic.

    Args:
        url: "ros2", or "ros2:/namespace".
        link: The robot's link, whose clock counts.
        config: Robot configuration, with `ros2.scan_topic`.
    """

    def __init__(self, url: str, link: Link, config: RobotConfig) -> None:
        self.topic = config.ros2.scan_topic
        self._url = url
        self._link = link
        self._config = config
        self._forget()

    def _forget(self) -> None:
        """Set the state of a closed LiDAR."""
        self._node: RosNode | None = None
        self._owns_node = False
        self._epoch = 0  # time of the node's clock at time 0 of the link's clock [ns]
        self._start = 0.0
        self._transforms: dict[str, tuple[str, Any]] = {}  # parents and transforms of frames
        self._mount: Mount | None = None
        self._newest: Revolution | None = None
        self._problem: LidarError | None = None

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Wait for a scan that starts after this call.

        Raises:
            LidarError: There are no scans, they can't be used, or the pose of the LiDAR is unknown.
        """
        node = self._open()
        self._newest = self._problem = None
        self._start = self._link.clock()
        timeout = self._config.connect_timeout
        if not node.wait_until(lambda: self._newest, timeout, WHILE_WAITING.get()):
            self.scan()

    def _open(self) -> RosNode:
        """Return the node, with subscriptions."""
        # The node of a ROS link has the same clock. A separate node counts from its own start.
        ros_link = self._link.ros
        link_node = ros_link.node if ros_link else None
        if self._node is not None and (self._owns_node or self._node is link_node):
            return self._node

        self._forget()
        self._owns_node = link_node is None
        if ros_link and link_node:
            node = link_node
            self._epoch = ros_link.epoch
        else:
            node = RosNode("acsar_gym_lidar")
            self._epoch = node.now() - round(self._link.clock() * NANOSECONDS)
        self._node = node

        namespace = (self._url.partition(":")[2] or node.namespace).rstrip("/")
        topic = self._config.ros2.scan_topic
        self.topic = node.resolve(topic if topic.startswith("/") else f"{namespace}/{topic}")
        node.subscribe(self.topic, node.ros.LaserScan, self._on_scan, SCAN_DEPTH, best_effort=True)
        node.subscribe_transforms(self._on_static, moving=False, namespace=namespace)
        return node

    def _on_static(self, message: Any) -> None:
        """Take static transforms."""
        # A new transform may replace the one that is in use.
        self._mount = None
        for stamped in message.transforms:
            parent = stamped.header.frame_id.lstrip("/")
            self._transforms[stamped.child_frame_id.lstrip("/")] = (parent, stamped.transform)

    def _on_scan(self, message: Any) -> None:
        """Take a scan that started after the reset."""
        stamp = (read_stamp(message.header.stamp) - self._epoch) / NANOSECONDS
        fields = {name: getattr(message, name) for name in LaserScan._fields if name != "stamp"}
        scan = LaserScan(**fields, stamp=stamp)
        # Callbacks can't raise, so a problem is kept until `scan`.
        timeout = self._config.lidar.timeout

        try:
            mount = self._mount or self._find_mount(message.header.frame_id.lstrip("/"))
            revolution = read_scan(scan, mount, self.topic, timeout=timeout)
        except LidarError as error:
            self._problem = error
            return

        # A revolution of the last episode, or of another clock.
        if stamp < self._start:
            self._problem = LidarError(
                f"{self.topic}: its newest scan began {self._start - stamp:.2f} s before the reset",
                "do the clocks agree? In a simulation every node needs use_sim_time",
            )
            return
        self._newest = revolution
        self._mount = mount
        self._problem = None

    def _find_mount(self, frame: str) -> Mount:
        """Return the pose of the LiDAR, from where the robot's file has it."""
        config = self._config
        base = config.base_frame.lstrip("/")
        parent, transform = self._transforms.get(frame, ("", None))
        if base in (frame, parent):
            mount = Mount() if frame == base else read_mount(transform, self.topic)
            x = mount.x - config.lidar_x_offset
            y = mount.y - config.lidar_y_offset
            return Mount(x, y, mount.yaw)

        # The transform may come after the first scan.
        waited = self._link.clock() - self._start
        patience = min(STATIC_TIMEOUT, 0.5 * config.connect_timeout)
        if config.lidar_yaw is not None and waited > patience:
            return Mount(yaw=config.lidar_yaw)
        raise LidarError(
            f"{self.topic}: no transform from {show_value(base)} to its frame {show_value(frame)} "
            f"(/tf_static has {parent or 'nothing'} -> {frame})",
            "write the LiDAR's pose on the robot into its file: lidar_x_offset, lidar_y_offset and "
            f"lidar_yaw, as 'ros2 run tf2_ros tf2_echo {base} {frame}' shows them",
        )

    def scan(self) -> Revolution:
        """Return the newest revolution, without waiting.

        Raises:
            LidarError: There is no revolution, it is older than lidar.timeout, or the newest scan
                can't be used.
        """
        if self._node is None:
            raise LidarError(f"LiDAR {self.topic} is closed", "call reset() first")
        if self._owns_node:
            self._node.spin(0.0)
        if self._problem is not None:
            raise self._problem.with_traceback(None)

        if self._newest is None:
            raise LidarError(
                f"LiDAR {self.topic}: no scan in {self._config.connect_timeout:g} s",
                self._node.problem
                or f"start its node, or set ros2.scan_topic (ros2 topic hz {self.topic})",
            )
        now = self._link.clock()
        check_age(self._newest, now, f"LiDAR {self.topic}", config=self._config)
        return self._newest

    def close(self) -> None:
        """End the separate node, if there is one. Idempotent."""
        if self._node is not None and self._owns_node:
            self._node.close()
        self._forget()
