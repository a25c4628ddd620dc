"""Checks of a robot in ROS 2: topics, clock, and the rate and delay of its feedback."""

from __future__ import annotations

import math
from collections.abc import Iterator
from statistics import median

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError, EmergencyStopError, LinkError
from acsar_gym.links.ros2 import Ros2Link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.ros.node import COMMAND_KINDS
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.commission.checks import Check, warn_if
from acsar_gym.tools.sysid.board import measure_rate, round_rate

LISTEN_TIME = 3.0
"""How long the robot is listened to [s]."""
LATE_FEEDBACK = 0.02
"""Delays of the wheels' messages above which the report warns [s]."""
AHEAD_FEEDBACK = 0.002
"""Messages that arrive earlier than their stamps by this much are of another clock [s]."""
RATE_TOLERANCE = 0.05
"""Largest relative difference between the measured and the configured rate."""
MAX_LATE_SHARE = 0.01
"""Share of late ticks above which the report warns."""


def examine_ros(url: str, config: RobotConfig, recorder: Recorder | None = None) -> Iterator[Check]:
    """Check a robot in ROS while zeros are commanded. The first failure ends the checks.

    Nothing is published if another node commands the robot.

    Args:
        url: URL of its link, such as "ros2:/robot1".
        config: Robot configuration.
        recorder: Records the robot.

    Raises:
        EmergencyStopError: The emergency stop was used.
    """
    # The robot is driven as a policy would, with zeros.
    link = Ros2Link(url, config)
    robot = Robot(link, config, recorder=recorder)
    stamps: list[float] = []
    try:
        robot.activate()
        command_type = COMMAND_KINDS[link.command_kind]
        topics = f"{link.command_topic} ({command_type}), {link.feedback_topic}"
        yield Check("topics", "ok", topics)
        publishers = link.feedback_publishers
        yield warn_if(
            len(publishers) > 1,
            "publishers",
            f"{len(publishers)} of {link.feedback_topic}: {', '.join(publishers)}",
            "only one of them may publish the wheels: end the others, or let them leave these out",
        )
        yield warn_if(
            bool(link.unwatched),
            "watchdog",
            f"doesn't run: {link.unwatched}" if link.unwatched else "its own process",
            "set watchdog_timeout in the robot's file",
        )

        link.delays.clear()  # those of the opening waited

        # Zeros are commanded meanwhile, as in each drive.
        for _ in range(math.ceil(LISTEN_TIME / config.period)):
            robot.drive(0.0, 0.0)
            if robot.safety.reason is Reason.EMERGENCY_STOP:
                raise EmergencyStopError  # noqa: TRY301 - closes the robot as others do
            stamps += [stamp for stamp, _ in link.arrivals]

        yield warn_if(
            bool(link.commanders),
            "other commanders",
            ", ".join(link.commanders) or "none",
            "end them, or let a twist_mux choose",
        )

        # The twin prints at the configured rate.
        rate = round_rate(measure_rate(stamps, range(len(stamps))))
        configured = config.feedback_rate
        yield warn_if(
            abs(rate - configured) > RATE_TOLERANCE * configured,
            "feedback rate",
            f"{rate:g} Hz, {configured:g} in the robot's file",
            f"set firmware.feedback_rate: {rate:g}, which its twin then has as well",
        )
        yield warn_if(
            bool(link.refused),
            "refused messages",
            link.refused or "none",
            "correct their publisher",
        )

        # A delay below zero means that the clocks of two computers differ.
        delay = median(link.delays)
        by_clock = ", by /clock" if link.uses_sim_time else ""
        yield warn_if(
            not (by_clock or -AHEAD_FEEDBACK < delay < LATE_FEEDBACK),
            "feedback delay",
            f"{1e3 * delay:.1f} ms from the stamp of the wheels to their arrival here, "
            f"{1e3 * max(link.delays):.1f} ms at most{by_clock}",
            "is the network slow, or do the clocks of both computers differ? set them by chrony "
            "(NTP)",
        )
        if robot.timing is not None:
            late = robot.timing.lateness
            yield warn_if(
                late.late_share > MAX_LATE_SHARE,
                "late ticks",
                f"{late.late_ticks} of {late.ticks}, worst {1e3 * late.worst:.1f} ms",
                BUSY_HINT,
            )
    except EmergencyStopError:
        raise
    except (LinkError, ConfigError) as error:
        fix = error.fix if isinstance(error, LinkError) else "correct the robot's file"
        yield Check("robot", "fail", getattr(error, "found", str(error)), fix)
    finally:
        robot.close()
