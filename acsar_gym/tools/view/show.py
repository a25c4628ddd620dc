"""Shows recordings, and drives while they go on."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import rerun as rr

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.recording import Episode, Recording, read
from acsar_gym.recording.blocks import Head
from acsar_gym.recording.events import Tables
from acsar_gym.recording.recorder import SinkMaker
from acsar_gym.recording.writer import Sink
from acsar_gym.tools.view.entities import EpisodeLogger, make_blueprint

HOST = "127.0.0.1"
START_TIMEOUT = 60.0  # longest wait for the viewer [s]
FLUSH_TIMEOUT = 5.0  # longest wait for data to be sent [s]
Connect = Callable[[rr.RecordingStream], None]
"""Sends a recording of Rerun somewhere."""


class RerunSink(Sink):
    """Writes each episode into a recording of Rerun.

    Args:
        config: Robot configuration.
        header: Header of the recording.
        connect: Called with each recording of Rerun.

    Attributes:
        count: Number of episodes.
    """

    def __init__(self, config: RobotConfig, header: Mapping[str, Any], connect: Connect) -> None:
        self.count = 0
        self._config = config
        self._header = header
        self._connect = connect
        self._end = 0.0
        self._is_live = False

    def write(self, head: Mapping[str, Any], tables: Tables) -> None:
        """Show a block of a drive that goes on."""
        self._is_live = True
        with contextlib.suppress(Exception):  # of a viewer that was closed: the drive goes on
            self.show(head["episode"], Episode(Head.model_validate(head), tables))

    def show(self, number: int, part: Episode) -> None:
        """Show a part of an episode with a number."""
        if number >= self.count:
            self._finish_episode()
            self._begin_episode(number, part)
        self._logger.log(part)
        # The last part may have no tick, only the command to stop.
        self._end = max(self._end, float(part.stamps.max(initial=part.start)) - part.start)

    def _begin_episode(self, number: int, part: Episode) -> None:
        self.count = number + 1
        self._end = 0.0
        self._stream = rr.RecordingStream("acsar_gym")
        self._connect(self._stream)
        seed = part.info.get("seed")
        name = f"episode {self.count}" + (f", seed {seed}" if isinstance(seed, int) else "")
        self._stream.send_recording_name(name)
        self._stream.send_blueprint(make_blueprint(part, is_live=self._is_live))
        self._logger = EpisodeLogger(self._stream, self._config, self._header)

    def _finish_episode(self) -> None:
        if self.count:
            self._stream.flush(timeout_sec=FLUSH_TIMEOUT)
            self._stream.disconnect()

    def end(self, text: str, level: str) -> None:
        """Note how the recording has ended."""
        if self.count:
            self._logger.log_lines([(self._end, text, level)])
        self._finish_episode()

    def close(self, dropped: int) -> None:
        """Note the end of a drive."""
        lost = f"; {dropped:,} events were dropped" if dropped else ""
        with contextlib.suppress(Exception):
            self.end(f"the recording ends{lost}", "WARN" if dropped else "INFO")


def write_recording(recording: Recording, connect: Connect) -> int:
    """Write the episodes of a recording into recordings of Rerun, and return their number."""
    sink = RerunSink(recording.config, recording.header, connect)
    for number, episode in enumerate(recording.episodes):
        for piece in episode.split():
            sink.show(number, piece)
    if recording.damages:
        sink.end(f"the recording ends; {recording.describe_damage()}", "WARN")
    elif recording.cut:
        sink.end("the recording's end is missing", "WARN")
    else:
        sink.close(recording.dropped)
    return sink.count


def save_recording(path: Path, target: Path) -> int:
    """Write a recording to an .rrd file. Returns the number of its episodes."""
    recording = read(path)
    # Each episode is a recording of Rerun in its own file. Its program joins them.
    with tempfile.TemporaryDirectory(prefix="acsar-view-", dir=target.parent) as folder:
        files: list[str] = []

        def connect(stream: rr.RecordingStream) -> None:
            # A stream can't append to a file.
            files.append(f"{folder}/{len(files)}.rrd")
            stream.save(files[-1])

        count = write_recording(recording, connect)
        merge = [find_rerun(), "rrd", "merge", *files, "-o", str(target)]
        done = subprocess.run(
            merge, check=False, capture_output=True, text=True, env=disable_analytics(folder)
        )
    if done.returncode:
        raise ConfigError(f"{target}: can't be written: {done.stderr.strip()[-200:]}")
    return count


def show_recording(path: Path) -> None:
    """Show a recording until the viewer is closed."""
    recording = read(path)
    viewer = start_viewer()
    try:
        write_recording(recording, viewer.connect)
        viewer.process.wait()
    finally:
        viewer.process.terminate()


def show_live() -> SinkMaker:
    """Open a viewer, and return what makes a recorder show its drive there."""
    viewer = start_viewer()
    return lambda config, header: RerunSink(config, header, viewer.connect)


class Viewer(NamedTuple):
    """A running viewer."""

    address: str
    process: subprocess.Popen[bytes]

    def connect(self, stream: rr.RecordingStream) -> None:
        """Send it a recording of Rerun."""
        stream.connect_grpc(self.address)


def find_rerun() -> str:
    """Return the path of Rerun's program. Raises MissingExtraError if it isn't installed."""
    with require_extra("the viewer", "view"):
        import rerun_cli  # noqa: PLC0415 - optional
    names = ("rerun.exe", "rerun", "Rerun.app/Contents/MacOS/Rerun")
    folder = Path(rerun_cli.__path__[0])
    return str(next((folder / name for name in names if (folder / name).is_file()), "rerun"))


def disable_analytics(folder: str) -> dict[str, str]:
    """Return the environment for Rerun's program, whose analytics are off by settings in `folder`.

    The user's own settings of Rerun aren't changed.
    """
    # Relative paths in these variables are ignored, by the XDG specification.
    home = str(Path(folder).absolute())
    environment = {**os.environ, "RUST_LOG": "error"}
    environment |= {"XDG_CONFIG_HOME": home, "XDG_DATA_HOME": home}
    off = [find_rerun(), "analytics", "disable"]
    subprocess.run(off, check=False, env=environment, capture_output=True)
    return environment


def start_viewer() -> Viewer:
    """Open a window of Rerun's viewer, which outlives this program. ConfigError if it fails."""
    # The system chooses a free port, which another program could take before the viewer.
    with socket.create_server((HOST, 0)) as listener:
        port = listener.getsockname()[1]
    folder = tempfile.mkdtemp(prefix="acsar-view-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    environment = disable_analytics(folder)

    # A new session: Ctrl-C in the terminal ends the drive, not the viewer.
    command = [find_rerun(), "--bind", HOST, "--port", str(port), "--expect-data-soon"]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            command, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        deadline = time.monotonic() + START_TIMEOUT
        while process.poll() is None and time.monotonic() < deadline:
            # A connection that is accepted shows that the viewer is ready.
            with contextlib.suppress(OSError), socket.create_connection((HOST, port), 1.0):
                return Viewer(f"rerun+http://{HOST}:{port}/proxy", process)
            time.sleep(0.1)

        process.terminate()
        log.seek(0)
        lines = log.read().decode(errors="replace").strip().splitlines()
    why = lines[-1][:200] if lines else f"not within {START_TIMEOUT:g} s"
    raise ConfigError(f"the viewer doesn't start: {why}: use view --save FILE.rrd")
