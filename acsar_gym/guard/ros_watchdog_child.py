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


def join_robot(
    name: str, topic: str, kind: str, joints: int, subscriptions: int, *, sim_time: bool
) -> Callable[[], None]:
    """Return what publishes zeros, as soon as all subscriptions that the program knows are known.

    One subscription is the program's own: a watchdog that knows only that reaches no robot.
    """
    node = RosNode(name)
    command = make_command(node.ros, kind)
    if kind == "wheel_speeds":
        command.data = [0.0] * joints  # controllers refuse any other number
    publisher = node.publish(topic, type(command))
    is_stamped = kind == "twist_stamped" and not sim_time  # else zero, which means now

    deadline = time.monotonic() + MATCH_TIMEOUT
    matched = 0
    while matched < subscriptions and time.monotonic() < deadline:
        time.sleep(0.01)
        matched = publisher.get_subscription_count()
    if matched < FEWEST_SUBSCRIPTIONS:
        raise SystemExit  # so that the program doesn't drive without it

    def stop_robot() -> None:
        if is_stamped:
            command.header.stamp = make_stamp(node.ros, node.now())
        with contextlib.suppress(Exception):  # rclpy has no common class
            publisher.publish(command)

    # The robot may know this node later than this node knows the robot: wait for a zero.
    stop_robot()
    remaining = max(deadline - time.monotonic(), 0.0)
    publisher.wait_for_all_acked(node.make_duration(remaining))
    return stop_robot


if __name__ == "__main__":
    join_program(lambda arguments: join_robot(**json.loads(arguments[0])))
