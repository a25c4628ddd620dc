"""The watchdog process of a robot in ROS: it publishes zeros when the program no longer can.

Its own node needs nothing of the program that hangs or is dead. The node knows the robot from the
start, as a new node would take too long to find it. `watchdog_child` decides when zeros are due.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable

from acsar_gym.guard.watchdog_child import join_program
from acsar_gym.ros.node import RosNode, make_command, make_stamp

MATCH_TIMEOUT = 15.0  # longest wait for the subscriptions of robot and program [s]
FEWEST_SUBSCRIPTIONS = 2  # a third that the program knows may have ended meanwhile


class CommandPublisher:
    """Publishes zero commands, as soon as it knows all subscriptions that the program knows.

    One subscription is the program's own: a watchdog that knows only that reaches no robot.
    """

    def __init__(
        self, name: str, topic: str, kind: str, joints: int, subscriptions: int, *, sim_time: bool
    ) -> None:
        self._node = RosNode(name)
        self._command = make_command(self._node.ros, kind)
        if kind == "wheel_speeds":
            self._command.data = [0.0] * joints  # controllers refuse any other number
        self._publisher = self._node.publish(topic, type(self._command))
        self._is_stamped = kind == "twist_stamped" and not sim_time  # else zero, which means now

        deadline = time.monotonic() + MATCH_TIMEOUT
        matched = 0
        while matched < subscriptions and time.monotonic() < deadline:
            time.sleep(0.01)
            matched = self._publisher.get_subscription_count()
        if matched < FEWEST_SUBSCRIPTIONS:
            raise SystemExit  # so that the program doesn't drive without it

        # The robot may know this node later than this node knows the robot: wait for a zero.
        self.stop_robot()
        remaining = max(deadline - time.monotonic(), 0.0)
        self._publisher.wait_for_all_acked(self._node.make_duration(remaining))

    def stop_robot(self) -> None:
        """Publish zeros."""
        if self._is_stamped:
            self._command.header.stamp = make_stamp(self._node.ros, self._node.now())
        with contextlib.suppress(Exception):  # rclpy has no common class
            self._publisher.publish(self._command)


def publish_commands(arguments: list[str]) -> Callable[[], None]:
    """Return what publishes zeros, with the settings in the first argument."""
    return CommandPublisher(**json.loads(arguments[0])).stop_robot


if __name__ == "__main__":
    join_program(publish_commands)
