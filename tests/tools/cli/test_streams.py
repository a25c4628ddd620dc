"""Every command ends in one way where its streams are closed or full, and the terminal is kept."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import sys
import termios
import warnings
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from recording_tools import drive

from acsar_gym import RobotConfig, streams
from acsar_gym.__main__ import main
from acsar_gym.testing import wait_until
from acsar_gym.tools.cli import COMMANDS

pytestmark = [pytest.mark.usefixtures("deadline"), pytest.mark.xdist_group(__name__)]

LINKS = {"closed": None, "pipe": -1, "full": "/dev/full"}
"""Where a stream leads to: nowhere, to a pipe that nobody reads, to a full disk."""
CLOSED_PIPE = 128 + 13
REAL = {
    "run": "run 1 0 --link planar",
    "drive": "drive --link planar --linear 0.1 --duration 0.2",
    "record info": "record info tape.mcap",
    "estop": "estop",
    "version": "--version",
    "help": "--help",
    "wrong": "drve",
}
"""Commands that do their work, and the exit code where all is well."""
CODES = {"estop": 1, "wrong": 2}


def run_with(
    words: str, path: Path, out: str = "", error: str = "", stdin: str = ""
) -> tuple[int, str, str]:
    """`acsar-gym WORDS` in a fork of this process, with streams that lead where `LINKS` says."""
    files = {1: (out, path / "out"), 2: (error, path / "error"), 0: (stdin, Path(os.devnull))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of libraries don't matter
        child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            os.chdir(path)
            for number, (kind, file) in files.items():
                lead_stream(number, LINKS.get(kind, str(file)))
            sys.argv = ["acsar-gym", *words.split()]
            try:
                main()
            except SystemExit as ended:
                for stream in (sys.stdout, sys.stderr):  # as Python does at its end
                    stream.flush()
                os._exit(ended.code if isinstance(ended.code, int) else 99)
        os._exit(98)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    texts = [files[n][1].read_text() if files[n][1].exists() else "" for n in (1, 2)]
    return code, texts[0], texts[1]


def lead_stream(number: int, to: str | int | None) -> None:
    """Let a standard stream lead somewhere, as a shell does before Python starts."""
    name = tuple(streams.STREAMS)[number]
    os.close(number)
    setattr(sys, name, None)
    setattr(sys, f"__{name}__", None)
    if to is None:
        return
    if isinstance(to, str):
        file = os.open(to, os.O_RDWR | os.O_CREAT, 0o600)
    else:
        read, file = os.pipe()
        os.close(read)
    if file != number:
        os.dup2(file, number)
        os.close(file)
    setattr(sys, name, open(number, streams.STREAMS[name], closefd=False))  # noqa: SIM115


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("streams")
    drive(folder / "tape.mcap", RobotConfig.preset("acsar"), 5)
    return folder


@pytest.mark.parametrize("name", [*REAL, *(f"{name} --help" for name in COMMANDS)])
def test_output_that_is_lost_ends_every_command_in_one_way(name: str, place: Path) -> None:
    words = REAL.get(name, name)
    code = CODES.get(name, 0)
    said = "acsar-gym: the output can't be written: No space left on device\n"
    assert run_with(words, place, out="closed")[0] == code
    assert "Traceback" not in (place / "error").read_text()
    (place / "error").unlink()
    if name == "wrong":  # says nothing on standard output
        assert run_with(words, place, error="pipe")[0] == run_with(words, place, error="full")[0]
        return
    assert run_with(words, place, out="pipe") == (code or CLOSED_PIPE, "", "")
    assert run_with(words, place, out="full") == (code or 2, "", said)
    (place / "error").unlink()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("drive --link planar", "give a fixed twist with --linear and --angular"),
        ("run 1 0 --link /dev/acsar-missing", "no terminal to ask on; add --yes"),
        ("identify /dev/acsar-missing", "no terminal to ask on; add --yes"),
        ("doctor /dev/acsar-missing --spin", "no terminal to ask on; add --yes"),
    ],
)
def test_a_service_without_streams_is_told_what_to_do(words: str, said: str, place: Path) -> None:
    code, _, error = run_with(words, place, stdin="closed", out="closed")
    assert (code, error.count("\n")) == (2, 1)
    assert said in error
    (place / "error").unlink()
    assert run_with(words, place, stdin="closed", out="closed", error="closed")[0] == 2


def test_a_closed_stream_gives_its_number_to_no_other_file(place: Path) -> None:
    """Such as a robot's port, to which children would write what they print."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        for number in range(3):
            lead_stream(number, None)
        streams.open_streams()
        opened = os.open(os.devnull, os.O_RDONLY)
        print("nothing", file=sys.stderr, flush=True)
        os.write(write, b"%d %d %d" % (opened, os.get_inheritable(1), sys.stdin.read() == ""))
        os._exit(0)
    os.waitpid(child, 0)
    opened, inherited, empty = map(int, os.read(read, 100).split())
    os.close(read)
    os.close(write)
    assert opened > 2
    assert (inherited, empty) == (1, 1)


@pytest.mark.parametrize("way", ["terminate", "kill -HUP", "q", "q >&-"])
def test_a_terminal_echoes_again_whatever_ends_a_drive(way: str, place: Path) -> None:
    closed = way[1:]  # a redirection
    closed = closed if closed.startswith(" >") else ""
    command = f"'{sys.executable}' -m acsar_gym drive --link planar{closed}"
    line = f"{command}; echo code $?; stty -a; echo done"
    shell, terminal = pty.fork()
    if shell == 0:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the tests run under nohup
        os.execvp("bash", ["bash", "-c", line])  # noqa: S606

    def echoes() -> bool:
        return bool(termios.tcgetattr(terminal)[3] & termios.ECHO)

    wait_until(lambda: not echoes(), "a drive that reads keys")
    (program,) = psutil.Process(shell).children()
    end: dict[str, Callable[[], object]] = {
        "terminate": program.terminate,
        "kill -HUP": lambda: program.send_signal(1),
    }
    end.get(way, lambda: os.write(terminal, b"q"))()
    output = b""
    while b"done\r\n" not in output:
        output += os.read(terminal, 4096)
    os.waitpid(shell, 0)
    os.close(terminal)
    assert b" echo " in output
    assert (b"code 0\r\n" in output) == way.startswith("q"), output
