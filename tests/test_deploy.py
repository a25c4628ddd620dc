"""assets/deploy: units, images and rules fit the commands and each other."""

from __future__ import annotations

import functools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import psutil
import pytest
from serial_tools import TIMEOUT, Emulated, wait_until

from acsar_gym.guard.watchdog_child import IGNORED_SIGNALS
from acsar_gym.resources import ASSETS
from acsar_gym.tools.cli import app
from acsar_gym.tools.cli.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
DEPLOY = ASSETS / "deploy"
UNITS = sorted(DEPLOY.glob("*.service"))
PLACE = "/opt/acsar/bin/acsar-gym"
"""Where the units and the image have the command."""


def read_unit(path: Path) -> dict[str, list[str]]:
    """Options of a unit, each of which may come more than once."""
    options: dict[str, list[str]] = {}
    for key, value in re.findall(r"^(\w+)=(.*)$", path.read_text(encoding="utf-8"), re.M):
        options.setdefault(key, []).append(value)
    return options


def read_command(path: Path) -> list[str]:
    """The words that a unit runs, with its own environment filled in."""
    unit = read_unit(path)
    variables = dict(shlex.split(text)[0].split("=", 1) for text in unit["Environment"])
    words: list[str] = []
    for word in shlex.split(unit["ExecStart"][0]):
        words += shlex.split(variables[word[1:]]) if word.startswith("$") else [word]
    return words


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_run_a_command_that_exists(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, name, *words = read_command(path)
    assert (program, name) == (PLACE, "run")
    parsed: dict[str, Any] = {}
    command = COMMANDS[name]

    @functools.wraps(command.function)
    def note(**options: Any) -> int:
        parsed.update(options)
        return 0

    monkeypatch.setitem(COMMANDS, name, command._replace(function=note))
    assert app.parse_command([name, *words]) == 0
    assert parsed["yes"]  # no user is there to press a key
    assert parsed["robot"].link == "/dev/acsar"
    assert str(parsed["robot"].record).startswith("/var/lib/acsar/")
    assert read_unit(path)["CPUSchedulingPolicy"] == ["fifo"]


def test_units_leave_the_watchdog_its_time() -> None:
    service = read_unit(DEPLOY / "acsar-run.service")
    assert service["KillMode"] == ["control-group"]
    assert service["KillSignal"] == ["SIGTERM"]
    assert "SIGTERM" in IGNORED_SIGNALS
    assert int(service["TimeoutStopSec"][0]) >= 5
    assert service["Restart"] == ["no"]
    assert "PrivateTmp" not in service  # acsar-gym estop listens in /tmp


def test_images_install_extras_that_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (DEPLOY / "Dockerfile").read_text(encoding="utf-8")
    extras = re.findall(r"^ARG EXTRAS=(\S+)", text, re.M)[0].split(",")
    assert {"deploy", *extras} <= set(project["optional-dependencies"])


def test_udev_rules_give_the_robot_its_name() -> None:
    assert 'SYMLINK+="acsar"' in (DEPLOY / "70-acsar.rules").read_text(encoding="utf-8")


AS_USER = () if os.geteuid() == 0 else ("--user", "--map-current-user")
CONTAINER = ("unshare", *AS_USER, "--pid", "--fork", "--kill-child")
"""A PID namespace: the end of its first process kills all others, as in a container."""


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_entrypoint_stops_the_wheels_when_the_program_ends(
    number: signal.Signals, emulator: Emulated
) -> None:
    has_unshare = shutil.which("unshare") is not None
    if not has_unshare or subprocess.run([*CONTAINER, "true"], check=False).returncode:
        pytest.skip("needs a PID namespace")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    words = ["drive", "--link", emulator.device, "--linear", "0.2"]
    with subprocess.Popen(
        [*CONTAINER, DEPLOY / "entrypoint.sh", *words],
        env={**os.environ, "PATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as container:
        wait_until(emulator.is_driven, "a command that turns the wheels")

        (program,) = (
            process
            for process in psutil.Process(container.pid).children(recursive=True)
            if process.cmdline()[-len(words) :] == words
            and "entrypoint" not in " ".join(process.cmdline())
        )
        program.send_signal(number)
        assert container.wait(TIMEOUT) == 128 + number
    wait_until(emulator.is_stopped, "zero as the last command")
