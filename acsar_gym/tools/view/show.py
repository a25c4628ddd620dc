"""Shows a recording."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rerun as rr

from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.links.factory import is_device
from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools.view.entities import APPLICATION, EpisodeLogger, make_blueprint
from acsar_gym.tools.view.parts import Part, Tape
from acsar_gym.tools.view.viewer import merge_files, open_viewer

RECORD_HINT = "drive with --record FILE, and view that file"


def find_recording(source: str) -> Path:
    """Return the path of a recording.

    Raises:
        ConfigError: It is a link, which only a recording of its robot can show.
    """
    path = Path(source.removeprefix("replay:"))
    is_recording = path.suffix == ".mcap" or path.is_file() or path.is_dir()
    if not is_recording and (source in BODIES or source == "serial" or is_device(source)):
        raise ConfigError(f"{source}: isn't a recording: {RECORD_HINT}")
    return path


def read_seed(part: Part) -> int | None:
    """Return the seed of an episode; None if it isn't known."""
    seed = part.info.get("seed")
    return seed if isinstance(seed, int) else None


class RerunWriter:
    """Writes the episodes of a recording into recordings of Rerun.

    Args:
        tape: The recording.
        connect: Called with each recording of Rerun, to send it somewhere.

    Attributes:
        count: Number of episodes that were written.
    """

    def __init__(self, tape: Tape, connect: Callable[[rr.RecordingStream], None]) -> None:
        self.count = 0
        self._tape = tape
        self._connect = connect
        self._stream: Any = None
        self._number = -1
        self._end = 0.0

    def write(self) -> None:
        """Write all episodes.

        Raises:
            ConfigError: There are none.
        """
        for part in self._tape.read_parts():
            if part.episode != self._number:
                self._finish_episode()
                self._begin_episode(part)
            self._logger.log(part)
            self._end = max(self._end, float(part.ticks["stamp"].max(initial=0.0)))
        if not self.count:
            raise ConfigError(f"{self._tape.path}: holds no episode")
        text = self._tape.describe_end()
        self._logger.log_text(self._end, text, "INFO" if text == "the recording ends" else "WARN")
        self._finish_episode()

    def _begin_episode(self, part: Part) -> None:
        self._number = part.episode
        self._end = 0.0
        self._stream = stream = rr.RecordingStream(APPLICATION)
        self._connect(stream)
        self.count += 1
        seed = read_seed(part)
        name = f"episode {part.episode + 1}" + ("" if seed is None else f", seed {seed}")
        stream.send_recording_name(name)
        stream.send_blueprint(make_blueprint(part))
        self._logger = EpisodeLogger(stream, self._tape.config, self._tape.header)

    def _finish_episode(self) -> None:
        """Send all of the episode."""
        if self._stream is not None:
            self._stream.flush()
            self._stream.disconnect()
        self._stream = None


def save_recording(path: Path, target: Path) -> int:
    """Write a recording to an .rrd file; returns the number of its episodes."""
    tape = Tape(path)
    with tempfile.TemporaryDirectory(prefix="acsar-view-", dir=target.parent) as folder:
        files: list[Path] = []

        def connect(stream: rr.RecordingStream) -> None:
            files.append(Path(folder) / f"{len(files)}.rrd")
            stream.save(files[-1])

        RerunWriter(tape, connect).write()
        merge_files(files, target)
    return len(files)


def show_recording(path: Path, port: int | None) -> None:
    """Show a recording until the viewer is closed, or, at the page of a port, until Ctrl-C."""
    tape = Tape(path)
    with open_viewer(port) as viewer:
        RerunWriter(tape, lambda stream: stream.connect_grpc(viewer.address)).write()
        if viewer.url:
            text = f"{path}: open {viewer.url} in a browser; Ctrl-C ends it"
            print(escape_unprintable(text), flush=True)
        viewer.process.wait()
