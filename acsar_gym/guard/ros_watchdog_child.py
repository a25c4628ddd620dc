"""The watchdog process of a robot in ROS: it publishes zeros when the program can't any more.

It has a node of its own, so that it needs nothing of the program that hangs or is dead; that node
knows the robot from the start on, as a new one would take too long to find it. Else it is as
`watchdog_child`, which says when zeros are due.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable

from acsar_gym.guard.watchdog_child import Stopper, join_program
from acsar_gym.ros.node import RosNode, make_command, make_stamp

MATCH_TIMEOUT = 15.0  # longest wait for the subscriptions of robot and program [s]
FEWEST_SUBSCRIPTIONS = 2  # one more may have ended meanwhile, such as somebody's who looked


class CommandPublisher(Stopper):
    """Publishes zero commands, once it knows all subscriptions that the program knows.

    One of them is the program's own: a watchdog that knows that one alone reaches nobody.
    """

    def __init__(
        self, name: str, topic: str, kind: str, joints: int, subscriptions: int, *, sim_time: bool
    ) -> None:
        self._node = RosNode(name)
        self._command = make_command(self._node.ros, kind)
        if kind == "wheel_speeds":
            self._command.data = [0.0] * joints  # controllers refuse any other number
        self._publisher = self._node.publish(topic, type(self._command))
        self._stamped = kind == "twist_stamped" and not sim_time  # else zero, which means now
        deadline = time.monotonic() + MATCH_TIMEOUT
        matched = 0
        while matched < subscriptions and time.monotonic() < deadline:
            time.sleep(0.01)
            matched = self._publisher.get_subscription_count()
        if matched < FEWEST_SUBSCRIPTIONS:
            raise SystemExit  # so that nobody drives without it
        # The robot may know this node later than this one knows the robot: until it has a zero.
        self.stop_robot()
        remaining = max(deadline - time.monotonic(), 0.0)
        self._publisher.wait_for_all_acked(self._node.make_duration(remaining))

    def stop_robot(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        """Publish zeros if `wanted()`; returns whether they were sent."""
        if not wanted():
            return False
        if self._stamped:
            self._command.header.stamp = make_stamp(self._node.ros, self._node.now())
        with contextlib.suppress(Exception):  # rclpy has no common class
            self._publisher.publish(self._command)
            return True
        return False


if __name__ == "__main__":
    join_program(lambda rest: CommandPublisher(**json.loads(rest[0])))
