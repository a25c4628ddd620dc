"""A LiDAR that is in ROS 2: its scans, and where it sits, by /tf_static."""

from __future__ import annotations

from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.lidar.contract import check_age
from acsar_gym.lidar.laser_scan import (
    LaserScan,
    Mount,
    Transform,
    find_mount,
    find_transform,
    move_revolution,
    read_scan,
)
from acsar_gym.lidar.scan import Revolution
from acsar_gym.links.base import WHILE_WAITING, Link
from acsar_gym.ros.node import NANOSECONDS, RosNode, read_stamp
from acsar_gym.worlds import Scene

SCAN_DEPTH = 5
"""Scans that wait while a program doesn't step."""
STATIC_DEPTH = 100
"""Most nodes that publish /tf_static."""
BESIDE_TIMEOUT = 1.0
"""Longest wait for the transform of a scanner whose frame is that of the robot's file [s]."""


class RosLidar:
    """The scans of a topic. It uses the node of a link that has one, and else one of its own.

    Attributes: `topic`, of the scans.

    Args:
        url: "ros2", or "ros2:/namespace".
        link: of the robot, whose clock counts.
        config: of the robot; `config.ros2.scan_topic`.
    """

    def __init__(self, url: str, link: Link, config: RobotConfig) -> None:
        self.topic = config.ros2.scan_topic
        self._namespace = url.partition(":")[2] or "/"
        self._link = link
        self._config = config
        self._forget()

    def _forget(self) -> None:
        self._node: RosNode | None = None
        self._is_own = False
        self._offset = 0
        self._transforms: dict[str, Transform] = {}
        self._mount: Mount | None = None
        self._since = 0.0
        self._newest: Revolution | None = None
        self._problem: LidarError | None = None

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Wait for a scan that was begun after this.

        Raises:
            LidarError: nobody publishes scans, or they can't be used, or nothing says where their
                frame is.
        """
        node = self._find_node()
        self._newest = self._problem = None
        self._since = self._link.clock()
        timeout = self._config.connect_timeout
        if not node.wait_until(lambda: self._newest, timeout, WHILE_WAITING.get()):
            self.scan()

    def _find_node(self) -> RosNode:
        """Return the node, with its subscriptions."""
        inner = self._link.ros
        theirs = None if inner is None else inner.node
        if self._node is not None and (self._is_own or self._node is theirs):
            return self._node
        self._forget()
        self._is_own = theirs is None
        self._node = node = theirs or RosNode("acsar_gym_lidar")
        if inner is None or self._is_own:
            self._offset = node.now() - round(self._link.clock() * NANOSECONDS)
        else:
            self._offset = inner.epoch
        topic = self._config.ros2.scan_topic
        if self._namespace != "/" and not topic.startswith("/"):
            topic = f"{self._namespace.rstrip('/')}/{topic}"
        self.topic = node.resolve(topic)
        if node.ros.TFMessage is not None:
            node.subscribe(
                "/tf_static", node.ros.TFMessage, self._on_static, STATIC_DEPTH, latched=True
            )
        node.subscribe(self.topic, node.ros.LaserScan, self._on_scan, SCAN_DEPTH, best_effort=True)
        return node

    def _on_static(self, message: Any) -> None:
        for stamped in message.transforms:
            place, turn = stamped.transform.translation, stamped.transform.rotation
            self._transforms[stamped.child_frame_id] = Transform(
                stamped.header.frame_id,
                (place.x, place.y, place.z),
                (turn.x, turn.y, turn.z, turn.w),
            )
        self._mount = None

    def _on_scan(self, message: Any) -> None:
        when = (read_stamp(message.header.stamp) - self._offset) / NANOSECONDS
        if when < self._since:
            return
        scan = LaserScan(
            message.angle_min,
            message.angle_increment,
            message.time_increment,
            message.scan_time,
            message.range_min,
            message.range_max,
            message.ranges,
            when,
        )
        try:
            if self._mount is None:
                self._mount = self._find_mount(message.header.frame_id)
            mount, config = self._mount, self._config
            revolution = read_scan(scan, mount, self.topic)
            offset = mount.x - config.lidar_x_offset, mount.y - config.lidar_y_offset
            self._newest = move_revolution(revolution, *offset)
            self._problem = None
        except LidarError as error:
            self._problem = error

    def _find_mount(self, frame: str) -> Mount:
        """Where the scanner sits; as the robot's file says, where its frame is named there."""
        config = self._config
        try:
            transform = find_transform(self._transforms, frame, config.base_frame, self.topic)
        except LidarError:
            # The transform may come after the first scan.
            waited = self._link.clock() - self._since > BESIDE_TIMEOUT
            if frame.lstrip("/") == config.lidar_frame and waited:
                return Mount(config.lidar_x_offset, config.lidar_y_offset)
            raise
        return find_mount(*transform, self.topic)

    def scan(self) -> Revolution:
        """Return the newest revolution; doesn't wait.

        Raises:
            LidarError: there is none, it is older than lidar.timeout, or the newest scan can't be
                used.
        """
        if self._node is None:
            raise LidarError(f"LiDAR {self.topic} is closed", "call reset() first")
        if self._is_own:
            self._node.spin(0.0)
        if self._problem is not None:
            raise LidarError(self._problem.found, self._problem.fix)
        if self._newest is None:
            raise LidarError(
                f"LiDAR {self.topic}: no scan in {self._config.connect_timeout:g} s",
                self._node.problem
                or f"start its node, or set ros2.scan_topic (ros2 topic hz {self.topic})",
            )
        check_age(f"LiDAR {self.topic}", self._newest, self._link.clock(), self._config)
        return self._newest

    def close(self) -> None:
        """End the node, if it is this LiDAR's own; idempotent."""
        node, is_own = self._node, self._is_own
        self._forget()
        if node is not None and is_own:
            node.close()

    def __reduce__(self) -> tuple[type[RosLidar], tuple[Any, ...]]:
        """Copies and pickles are closed LiDARs of the same topic."""
        return RosLidar, (f"ros2:{self._namespace}", self._link, self._config)
