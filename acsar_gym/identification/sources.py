"""Where the logs of an identification come from: recordings, or a manoeuvre driven now."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.identification.identified import Identified, identified
from acsar_gym.identification.manoeuvre import drive
from acsar_gym.links import Link
from acsar_gym.recording import Recorder
from acsar_gym.recording.alike import check_same
from acsar_gym.recording.reader import read
from acsar_gym.recording.wire_log import WireLog


def from_files(paths: Sequence[Path], config: RobotConfig | None) -> Identified:
    """Identify a robot from recordings.

    Args:
        paths: of recordings of one robot.
        config: of the robot; None for the one that was recorded.

    Raises:
        ConfigError: a file can't be read, or they are of different robots.
    """
    recordings = [(path, read(path)) for path in paths]
    check_same([(str(path), recording) for path, recording in recordings], "identify")
    logs = [episode.wire for _, recording in recordings for episode in recording.episodes]
    hashes = [recording.sha256 for _, recording in recordings]
    return identified(logs, config or recordings[0][1].config, hashes)


def from_device(
    link: Link, config: RobotConfig, duration: float, recorder: Recorder | None = None
) -> Identified:
    """Drive the manoeuvre, and identify the robot from it. Errors as for `manoeuvre.drive`."""
    log = drive(link, config, duration, recorder)
    path = None if recorder is None or recorder.problem else recorder.path
    return identified([log], config, [digest(log) if path is None else read(path).sha256])


def digest(log: WireLog) -> str:
    """First 16 hex digits of the SHA-256 of what a wire carried."""
    whole = hashlib.sha256(log.sent_stamps.tobytes() + log.got_stamps.tobytes())
    whole.update(b"".join(log.sent + log.got))
    return whole.hexdigest()[:16]
