"""What a robot tells its recorder, tick by tick."""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.recording.encoder import Fault, Scanned, Tick
from acsar_gym.recording.recorder import Recorder
from acsar_gym.safety.layer import Safety
from acsar_gym.sensors import Sensor
from acsar_gym.sensors.lidar import newest_scan
from acsar_gym.wire import Wire


class Journal:
    """Tells a recorder what a robot does; does nothing without a recorder.

    Args:
        recorder: of the robot's link, or None.
        link: of the robot, as the other arguments.
        config: its parameters.
        wire: its end of the wire.
        safety: its safety layer.
        sensors: its sensors.
    """

    def __init__(
        self,
        recorder: Recorder | None,
        link: Link,
        config: RobotConfig,
        wire: Wire,
        safety: Safety,
        sensors: Sequence[Sensor],
    ) -> None:
        self._recorder = recorder
        self._link = link
        self._radii, self._separation = config.wheel_radii, config.effective_separation
        self._wire = wire
        self._safety = safety
        self._sensors = sensors
        self._stamp: float | None = None

    @property
    def recording(self) -> str:
        """The file that is recorded to, as an absolute path; empty for none."""
        path = None if self._recorder is None else self._recorder.path
        return "" if path is None else str(path.absolute())

    def began(self) -> None:
        """After a reset: tell the first scan."""
        self._stamp = None
        if self._recorder is not None:
            self._scanned(self._recorder)

    def ticked(self, odometry: Odometry, linear: float, angular: float) -> None:
        """After a tick in which a twist was asked for [m/s, rad/s]; NaN where none was."""
        recorder, wire = self._recorder, self._wire
        if recorder is None:
            return
        recorder.add(
            Tick(
                recorder.number - 1,
                wire.stamp,
                odometry.pose,
                odometry.twist,
                wire.speeds,
                odometry.wheel_positions,
                (float(linear), float(angular)),
                self._safety.sent,
                self._safety.reason,
                self._link.lateness,
                wire.age,
                sum(wire.decoder.refused.values()),
            )
        )
        self._scanned(recorder)

    def turned(self, odometry: Odometry, speeds: Sequence[float]) -> None:
        """After a tick in which wheel speeds were asked for [rad/s]."""
        if self._recorder is not None:
            a, b, c, d = map(float, speeds)
            twist = kinematics.compute_twist(a, b, c, d, *self._radii, self._separation)
            self.ticked(odometry, *twist)

    def listened(self, odometry: Odometry) -> None:
        """After a tick in which nothing was asked for."""
        self.ticked(odometry, math.nan, math.nan)

    def ended(self, error: BaseException | None) -> None:
        """When the robot is deactivated: tell the error that ended it, if any."""
        if self._recorder is not None and isinstance(error, Exception):
            self._recorder.add(Fault(self._link.now(), str(error)))

    def close(self) -> None:
        """Finish the recording; idempotent. Warns where it couldn't be written."""
        if self._recorder is not None:
            self._recorder.close()

    def _scanned(self, recorder: Recorder) -> None:
        """Tell a scan that is new."""
        scan = newest_scan(self._sensors)
        if scan is not None and scan.stamp != self._stamp:
            self._stamp = scan.stamp
            recorder.add(Scanned(recorder.number - 1, scan.stamp, scan.ranges))
