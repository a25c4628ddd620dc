"""What the figures in large type tell at a time of an episode."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.dashboard.episodes import TICK, Episode
from acsar_gym.safety.rules import Reason

NONE = "\N{EN DASH}"
SAID = {
    Reason.NONE: "sent as asked",
    Reason.LIMITS: "limits of speed or acceleration",
    Reason.GEOFENCE: "outside the geofence: held",
    Reason.STALE_FEEDBACK: "feedback too old: stopped",
    Reason.EMERGENCY_STOP: "emergency stop: held",
}


def readings(episode: Episode, time: float) -> dict[str, str]:
    """Return the texts of the page's tiles.

    Args:
        episode: what is shown.
        time: since its reset [s].

    Returns:
        `time`; `linear` and `angular` as asked, sent and measured, with `_asked`, `_sent` and
        `_measured` behind the name; `goal`; `late` and `worst`; `age`; `reason` and `said`.
    """
    place = episode.place(time)
    told = {"time": f"{time:.1f}", "end": f"of {episode.end:.1f} s"}
    names = [
        f"{kind}_{who}" for kind in ("linear", "angular") for who in ("asked", "sent", "measured")
    ]
    if place < 0:
        rest = ("goal", "late", "worst", "age", "reason", "said", "grade")
        return told | dict.fromkeys((*names, *rest), NONE)
    row = episode.ticks.rows[place]
    columns = ("asked_linear", "sent_linear", "linear", "asked_angular", "sent_angular", "angular")
    told |= {
        name: _number(row[TICK[column]], 2) for name, column in zip(names, columns, strict=True)
    }
    late = episode.column("lateness")[: place + 1]
    known = late[np.isfinite(late)]
    return told | {
        "goal": _distance(episode, place),
        "late": _milliseconds(late[-1]),
        "worst": _milliseconds(known.max()) if len(known) else NONE,
        "age": _number(row[TICK["feedback_age"]] * 1e3, 0),
        **_reason(row[TICK["reason"]]),
    }


def _number(value: float, digits: int) -> str:
    """A number with a true minus sign; a dash for NaN."""
    if not math.isfinite(value):
        return NONE
    text = f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text.removeprefix("-")


def _milliseconds(value: float) -> str:
    """A time [s] in milliseconds, with fewer digits where it is long."""
    return _number(value * 1e3, 2 if value < 0.01 else 1 if value < 0.1 else 0)


def _distance(episode: Episode, place: int) -> str:
    """Distance to the goal by odometry [m]."""
    if episode.goal is None:
        return NONE
    x, y = episode.column("x")[place], episode.column("y")[place]
    return _number(math.hypot(episode.goal[0] - x, episode.goal[1] - y), 2)


def _reason(number: float) -> dict[str, str]:
    """Name, words and grade of a reason."""
    try:
        reason = Reason(int(number))
    except (ValueError, OverflowError):
        return {"reason": NONE, "said": "unknown", "grade": "0"}
    return {
        "reason": reason.name.replace("_", " ").lower(),
        "said": SAID[reason],
        "grade": str(int(reason)),
    }
