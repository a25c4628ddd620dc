"""Checks of a robot in ROS 2: its topics, how often and how soon its wheels report, its clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from statistics import median

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, EmergencyStopError, LinkError
from acsar_gym.links.ros2 import Ros2Link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.commission.checks import Check, warn_if
from acsar_gym.tools.sysid.board import measure_rate, round_rate

LISTEN_TIME = 3.0
"""How long it is listened to [s]."""
LATE_FEEDBACK = 0.02
"""Delays of the wheels' messages above which the report warns [s]."""
AHEAD_FEEDBACK = 0.002
"""Messages that come earlier than their stamps by this much are of another clock [s]."""
RATE_TOLERANCE = 0.05
"""A rate is as configured within this share."""
MAX_LATE_SHARE = 0.01
"""Share of late ticks above which the report warns."""


def examine_ros(url: str, config: RobotConfig, recorder: Recorder | None = None) -> Iterator[Check]:
    """Check a robot in ROS while zeros are commanded; the first failure ends the checks.

    Args:
        url: of its link, such as "ros2:/robot1".
        config: of the robot.
        recorder: records it.

    Raises:
        EmergencyStopError: after the last result.
    """
    link = Ros2Link(url, config)
    robot = Robot(link, config, recorder=recorder)
    stamps: list[float] = []
    try:
        robot.activate()
        topics, others = link.topics, link.others
        yield Check(
            "topics", "ok", f"{topics['commands']} ({topics['type']}), {topics['feedback']}"
        )
        simulated = topics["clock"] == "/clock"
        yield warn_if(
            bool(others),
            "other commanders",
            f"{', '.join(others)} may command the robot as well" if others else "none",
            "end them, or let a twist_mux choose",
        )
        yield warn_if(
            bool(link.unwatched),
            "watchdog",
            f"doesn't run: {link.unwatched}" if link.unwatched else "a process of its own",
            "set watchdog_timeout in the robot's file",
        )
        link.delays.clear()  # those of the opening waited
        for _ in range(math.ceil(LISTEN_TIME / config.period)):
            robot.drive(0.0, 0.0)
            if robot.safety.reason is Reason.EMERGENCY_STOP:
                raise EmergencyStopError  # noqa: TRY301 - closes the robot as others do
            stamps += [stamp for stamp, _ in link.arrivals]
        delays, timing, refused = [*link.delays], robot.timing, link.refused
    except EmergencyStopError:
        raise
    except (LinkError, ConfigError) as error:
        fix = error.fix if isinstance(error, LinkError) else "mend the robot's file"
        yield Check("robot", "fail", getattr(error, "found", str(error)), fix)
        return
    finally:
        robot.close()
    rate = round_rate(measure_rate(stamps, range(len(stamps))))
    yield warn_if(
        abs(rate - config.feedback_rate) > RATE_TOLERANCE * config.feedback_rate,
        "feedback rate",
        f"{rate:g} Hz, the robot's file says {config.feedback_rate:g}",
        f"set firmware.feedback_rate: {rate:g}, which its twin then has, too",
    )
    yield warn_if(bool(refused), "refused messages", refused or "none", "mend what publishes them")
    usual = median(delays)
    fix = "is the network slow, or do the clocks of both computers differ? set them by chrony (NTP)"
    yield warn_if(
        not (simulated or -AHEAD_FEEDBACK < usual < LATE_FEEDBACK),
        "feedback delay",
        f"{1e3 * usual:.1f} ms from the stamp of the wheels to their arrival here, "
        f"{1e3 * max(delays):.1f} ms at most" + (", by /clock" if simulated else ""),
        fix,
    )
    if timing is not None:
        late = timing.lateness
        yield warn_if(
            late.late_share > MAX_LATE_SHARE,
            "late ticks",
            f"{late.late_ticks} of {late.ticks}, worst {1e3 * late.worst:.1f} ms",
            "end other programs, or drive with --realtime",
        )
