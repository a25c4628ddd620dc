"""Wheel speeds from the fields of sensor_msgs/JointState; pure, needs no ROS."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from acsar_gym.errors import show_value
from acsar_gym.protocol import Speeds

MAX_WHEEL_SPEED = 1000.0
"""No wheel turns faster; positions that say so jumped, as where encoders were reset [rad/s]."""


class JointReader:
    """Reads the speeds of four wheels from joint states, in any order and among other joints.

    Args:
        joints: names of the joints of the wheels a, b, c, d; one that stands for a side twice.

    Attributes: `refused`, how many messages were refused, by reason; `reason`, one line that says
    what was wrong with the newest message, empty where nothing was.

    Example:
        >>> reader = JointReader(["right", "left", "left", "right"])
        >>> reader.read(["left", "arm", "right"], [], [1.0, 0.0, 2.0], 0.01)
        (2.0, 1.0, 1.0, 2.0)
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._stamp = -math.inf
        self._positions: tuple[float, ...] | None = None
        self.refused: Counter[str] = Counter()
        self.reason = ""

    def read(
        self,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
        stamp: float,
    ) -> Speeds | None:
        """Read one message.

        Without velocities (an empty array, or NaN for all wheels, as joint_state_broadcaster
        writes where the hardware has none) speeds are the differences of positions since the
        message before.

        Args:
            names: of the joints.
            positions: [rad], one for each name, or none.
            velocities: [rad/s], one for each name, or none.
            stamp: of the header, on any clock [s].

        Returns:
            Speeds of the wheels a, b, c, d [rad/s]; None for a message of other joints, for the
            first one where positions must do, and for one that is refused: see `refused`.
        """
        if not {*names} & {*self._joints}:
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
        """The speeds that a message of the wheels says; None for the first one of positions."""
        places = self._find_joints(names)
        turned = _take("position", positions, len(names), places)
        speeds = _take("velocity", velocities, len(names), places)
        if speeds is None and turned is None:
            raise _RefusedError("no numbers", "has neither velocities nor positions of the wheels")
        self._check_finite("velocity", speeds or ())
        if speeds is None:
            self._check_finite("position", turned or ())
        if not self._stamp < stamp < math.inf:
            raise _RefusedError(
                "stamp", f"is stamped {stamp:.9g} s, not after the one before ({self._stamp:.9g} s)"
            )
        before, elapsed = self._positions, stamp - self._stamp
        self._stamp = stamp
        self._positions = turned if turned and all(map(math.isfinite, turned)) else None
        if speeds is None and before and turned:
            speeds = tuple((b - a) / elapsed for a, b in zip(before, turned, strict=True))
        if speeds is None:
            return None
        fastest = max(speeds, key=abs)
        if abs(fastest) > MAX_WHEEL_SPEED:
            joint = show_value(self._joints[speeds.index(fastest)])
            raise _RefusedError(
                "too fast",
                f"says that {joint} turns at {fastest:.4g} rad/s, more than {MAX_WHEEL_SPEED:,.0f}",
            )
        a, b, c, d = speeds
        return a, b, c, d

    def _find_joints(self, names: Sequence[str]) -> list[int]:
        """The wheels' places in a message; refused if one is missing, or named twice."""
        listed = Counter(name for name in names if name in self._joints)
        for joint in self._joints:
            if not listed[joint]:
                listing = ", ".join(map(show_value, names[:6])) + (", ..." if names[6:] else "")
                raise _RefusedError(
                    "joint missing", f"has no {show_value(joint)} (it has {listing})"
                )
            if listed[joint] > 1:
                raise _RefusedError(
                    "joint repeated", f"names {show_value(joint)} {listed[joint]} times"
                )
        return [names.index(joint) for joint in self._joints]

    def _check_finite(self, field: str, values: Sequence[float]) -> None:
        """Refuse NaN and inf."""
        for joint, value in zip(self._joints, values, strict=False):
            if not math.isfinite(value):
                raise _RefusedError(
                    "not finite", f"has {value} as the {field} of {show_value(joint)}"
                )


class _RefusedError(Exception):
    """Why a message can't be used; `kind` is what it counts as."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


def _take(
    field: str, values: Sequence[float], count: int, places: Sequence[int]
) -> tuple[float, ...] | None:
    """The wheels' values; None where there are none, or all are NaN."""
    if len(values) not in (0, count):
        raise _RefusedError(
            "wrong length", f"has {count} names and {len(values)} values of {field}"
        )
    taken = tuple(float(values[place]) for place in places) if len(values) else ()
    return taken if not all(map(math.isnan, taken)) else None
