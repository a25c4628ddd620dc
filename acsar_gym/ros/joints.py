"""Wheel speeds from the fields of sensor_msgs/JointState. This module is pure and needs no ROS."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from acsar_gym.errors import show_value
from acsar_gym.protocol import Speeds

MAX_WHEEL_SPEED = 1000.0
"""No wheel turns faster. If positions would mean more, encoders were reset [rad/s]."""
WRAPPING_RANGE = 4.0 * math.pi
"""Positions that wrap at a full turn, or at two, are smaller than this [rad]."""


class JointReader:
    """Reads the speeds of four wheels from joint states, in any order and among other joints.

    Args:
        joints: Names of the joints of the wheels a, b, c and d. A joint that drives both wheels of
            a side is named twice.
        wraps: Whether positions may wrap at full turns.

    Attributes:
        refused: Number of refused messages, by kind.
        reason: Why the newest message was refused, in one line. Empty if it wasn't.

    Example:
        >>> reader = JointReader(["right", "left", "left", "right"])
        >>> reader.read(["left", "arm", "right"], [], [1.0, 0.0, 2.0], 0.01)
        (2.0, 1.0, 1.0, 2.0)
    """

    def __init__(self, joints: Sequence[str], *, wraps: bool = True) -> None:
        self._joints = tuple(joints)
        self._wraps = wraps
        self._stamp = -math.inf
        self._positions: tuple[float, ...] | None = None
        self._speeds: tuple[float, ...] = (0.0,) * len(self._joints)
        self._has_velocities = False
        self.refused: Counter[str] = Counter()
        self.reason = ""

    def names_wheels(self, names: Sequence[str]) -> bool:
        """Return whether a message is about a wheel."""
        return not set(names).isdisjoint(self._joints)

    def read(
        self,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
        stamp: float,
    ) -> Speeds | None:
        """Read one message.

        Without velocities (an empty array, or NaN for all wheels, as joint_state_broadcaster
        publishes if the hardware has none), the speeds are the differences of the positions. Once
        velocities have been received, messages without them are refused: they come from another
        publisher, such as a joint_state_publisher.

        Args:
            names: Names of the joints.
            positions: Position of each joint [rad], or an empty array.
            velocities: Velocity of each joint [rad/s], or an empty array.
            stamp: Time of the header on any clock [s].

        Returns:
            Speeds of the wheels a, b, c and d [rad/s]. None if the message has other joints only,
            is the first one without velocities, or is refused (see `refused`).
        """
        if not self.names_wheels(names):
            return None
        try:
            speeds = self._measure(names, positions, velocities, stamp)
        except _RefusedError as error:
            self.refused[error.kind] += 1
            self.reason = f"joint_states {error}"
            return None
        self.reason = ""
        return speeds

    def _measure(
        self,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
        stamp: float,
    ) -> Speeds | None:
        self._check_names(names)

        # A message is refused as a whole, so that no wheel is older than the others.
        turned = self._select("position", positions, names)
        speeds = self._select("velocity", velocities, names)
        self._check_values(turned, speeds)
        if not self._stamp < stamp < math.inf:
            raise _RefusedError(
                "stamp",
                f"is stamped {stamp:.9g} s, not after the previous message ({self._stamp:.9g} s)",
            )

        # Speeds hold since the previous message, whenever this one arrived.
        elapsed = stamp - self._stamp
        previous = self._positions
        self._stamp = stamp
        self._positions = turned if turned and all(map(math.isfinite, turned)) else None
        if speeds is not None:
            self._has_velocities = True
        elif previous and turned:
            speeds = tuple(
                (
                    _unwrap(new - old, max(abs(new), abs(old)), speed * elapsed)
                    if self._wraps
                    else new - old
                )
                / elapsed
                for old, new, speed in zip(previous, turned, self._speeds, strict=True)
            )
        else:
            return None

        # Positions jump if encoders are reset.
        fastest = max(speeds, key=abs)
        if abs(fastest) > MAX_WHEEL_SPEED:
            # The positions are kept: the next difference is right again.
            joint = show_value(self._joints[speeds.index(fastest)])
            raise _RefusedError(
                "too fast",
                f"reports that {joint} turns at {fastest:.4g} rad/s, more than "
                f"{MAX_WHEEL_SPEED:,.0f}",
            )
        self._speeds = speeds
        a, b, c, d = speeds
        return a, b, c, d

    def _check_names(self, names: Sequence[str]) -> None:
        """Refuse a message that doesn't name each wheel once."""
        # A joint of a side is named once, though it drives two wheels.
        counts = Counter(name for name in names if name in self._joints)
        for joint in self._joints:
            if not counts[joint]:
                listing = ", ".join(map(show_value, names[:6])) + (", ..." if names[6:] else "")
                raise _RefusedError(
                    "joint missing", f"has no {show_value(joint)} (it has {listing})"
                )
            if counts[joint] > 1:
                raise _RefusedError(
                    "joint repeated", f"names {show_value(joint)} {counts[joint]} times"
                )

    def _select(
        self, field: str, values: Sequence[float], names: Sequence[str]
    ) -> tuple[float, ...] | None:
        """Return the values of the wheels. None if there are none, or all are NaN."""
        if len(values) not in (0, len(names)):
            raise _RefusedError(
                "wrong length", f"has {len(names)} names and {len(values)} values of {field}"
            )
        if not len(values):
            return None

        # Joints come in any order, between others.
        selected = tuple(float(values[names.index(joint)]) for joint in self._joints)
        return None if all(map(math.isnan, selected)) else selected

    def _check_values(
        self, positions: tuple[float, ...] | None, speeds: tuple[float, ...] | None
    ) -> None:
        """Refuse a message without values, or whose values aren't finite."""
        if speeds is None and positions is None:
            raise _RefusedError("no numbers", "has neither velocities nor positions of the wheels")
        if speeds is None and self._has_velocities:
            raise _RefusedError(
                "no velocities",
                "has no velocities, unlike earlier messages: a second node publishes the wheels",
            )
        field = "position" if speeds is None else "velocity"
        for joint, value in zip(self._joints, speeds or positions or (), strict=True):
            if not math.isfinite(value):
                raise _RefusedError(
                    "not finite", f"has {value} as the {field} of {show_value(joint)}"
                )


class _RefusedError(Exception):
    """Why a message can't be used. `kind` is the key under which it is counted."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


def _unwrap(difference: float, largest: float, expected: float) -> float:
    """Return a difference of positions [rad] without the full turns by which they wrapped.

    Args:
        difference: New position minus old position.
        largest: Larger magnitude of both. Beyond `WRAPPING_RANGE`, positions don't wrap.
        expected: Difference by the previous speed. The result is the one nearest to it.
    """
    if largest >= WRAPPING_RANGE:
        return difference
    return difference - math.tau * round((difference - expected) / math.tau)
