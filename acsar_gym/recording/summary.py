"""What a recording holds, in short."""

from __future__ import annotations

import hashlib
import math
import struct
from collections import Counter
from pathlib import Path
from typing import Any

from acsar_gym.reading import bounded
from acsar_gym.recording import records
from acsar_gym.recording.reader import MOST_BYTES, read
from acsar_gym.recording.records import Cut, Records
from acsar_gym.recording.types import Episode, Recording


def of(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON.

    Args:
        path: the recording.

    Raises:
        ConfigError: it can't be read.
    """
    recording = read(path)
    header = recording.header
    return {
        "file": str(path),
        "sha256": recording.sha256,
        "whole": not recording.cut,
        "dropped": None if recording.cut and not recording.dropped else recording.dropped,
        "duration": round(sum(map(_duration, recording.episodes)), 3),
        "about": header["about"],
        "robot": {
            "sha256": header["config_sha256"][:16],
            "base_frame": recording.config.base_frame,
            "simulated": _is_simulated(recording),
        },
        "versions": header["versions"],
        "created": header["created"],
        "topics": _topics(path),
        "episodes": [_episode(one) for one in recording.episodes],
    }


def lines(found: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    about, robot = found["about"], found["robot"]
    whole = "whole" if found["whole"] else "cut: what followed is missing"
    kind = "simulated" if robot["simulated"] else "real"
    told = ", ".join(f"{name} {_short(value)}" for name, value in about.items())
    episodes = found["episodes"]
    count = f"{len(episodes)} episode{'s' if len(episodes) != 1 else ''}"
    return [
        f"{found['file']}: {whole}; {count}, {found['duration']:.1f} s, {_lost(found)}",
        f"{kind} robot, config {robot['sha256']}; file {found['sha256']}",
        *([told] if told else []),
        *(
            f"episode {number}: {one['duration']:.1f} s, {one['ticks']:,} ticks, "
            f"{one['steps']} steps, {one['scans']} scans; {_short(one['info'])}"
            for number, one in enumerate(episodes[:20])
        ),
        *([f"... and {len(episodes) - 20} more episodes"] if len(episodes) > 20 else []),
        *(f"{name:<20} {count:>9,}" for name, count in found["topics"].items()),
    ]


def _lost(found: dict[str, Any]) -> str:
    """How many events were dropped; None where the end, which would tell it, is missing."""
    dropped = found["dropped"]
    if dropped is None:
        return "drops unknown"
    least = "" if found["whole"] else "at least "
    return f"{least}{dropped:,} dropped" if dropped else "nothing dropped"


def _duration(episode: Episode) -> float:
    """Duration of an episode [s]."""
    stamps = episode.exchanges.stamps
    return float(stamps[-1] - episode.start) if len(stamps) else 0.0


def _is_simulated(recording: Recording) -> bool:
    """Whether ground truth was recorded."""
    truths = [one.exchanges.truth for one in recording.episodes if len(one.exchanges.truth)]
    return bool(truths) and not math.isnan(truths[0][0, 0])


def _episode(episode: Episode) -> dict[str, Any]:
    """Sum up an episode."""
    return {
        "ticks": len(episode.stamps),
        "steps": len(episode.actions),
        "scans": len(episode.scans.stamps),
        "duration": round(_duration(episode), 3),
        "info": dict(episode.info),
    }


def _topics(path: Path) -> dict[str, int]:
    """How many messages each topic has."""
    names: dict[int, str] = {}
    counts: Counter[int] = Counter()
    with bounded.opened(path, MOST_BYTES) as file:
        try:
            for opcode, content in Records(file, hashlib.sha256()):
                if opcode == records.CHANNEL:
                    channel = records.described(opcode, content)
                    names[channel.id] = channel.topic
                elif opcode == records.MESSAGE and len(content) > 1:
                    counts[struct.unpack_from("<H", content)[0]] += 1
        except Cut:
            pass
    return {name: counts[number] for number, name in names.items() if counts[number]}


def _short(value: Any) -> str:
    """A value of the header on one line."""
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return text if len(text) <= 100 else f"{text[:100]}..."
