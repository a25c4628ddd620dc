"""assets/deploy: units, images and rules fit the commands and each other."""

from __future__ import annotations

import configparser
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
RULES = DEPLOY / "70-acsar.rules"
PLACE = "/opt/acsar/bin/acsar-gym"
"""Where the units and the image have the command."""
ENDED = -1
"""Exit code of a command that was only parsed."""


def unit(path: Path) -> dict[str, dict[str, list[str]]]:
    """Sections of a unit; options may come more than once."""
    parser = configparser.ConfigParser(
        strict=False, interpolation=None, delimiters=("=",), comment_prefixes=("#",)
    )
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    lines = path.read_text(encoding="utf-8").splitlines()
    numbered = [re.sub(r"^(\w+)=", rf"\1 {at}=", line) for at, line in enumerate(lines)]
    parser.read_string("\n".join(numbered))
    found: dict[str, dict[str, list[str]]] = {}
    for name in parser.sections():
        for key, value in parser[name].items():
            found.setdefault(name, {}).setdefault(key.split()[0], []).append(value)
    return found


def command(path: Path) -> list[str]:
    """The words that a unit runs, with its own environment filled in."""
    service = unit(path)["Service"]
    known = dict(shlex.split(text)[0].split("=", 1) for text in service["Environment"])
    (line,) = service["ExecStart"]
    words = []
    for word in shlex.split(line):
        words += shlex.split(known[word[1:]]) if word.startswith("$") else [word]
    return words


def parse(words: list[str], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What a command line means to the function of its command, which isn't called."""
    import functools

    given: dict[str, Any] = {}
    one = COMMANDS[words[0]]

    @functools.wraps(one.function)
    def note(*values: Any, **options: Any) -> int:
        given.update(options)
        return ENDED

    monkeypatch.setitem(COMMANDS, words[0], one._replace(function=note))
    assert app.parse_command(words) == ENDED
    return given


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_a_unit_runs_a_command_that_there_is(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *words = command(path)
    assert first == PLACE
    given = parse(words, monkeypatch)
    assert words[0] == "run"
    assert given["yes"]  # nobody is there to press a key
    assert given["robot"].link == "/dev/acsar"
    assert str(given["robot"].record).startswith("/var/lib/acsar/")
    assert given["host"].realtime + 1 <= int(unit(path)["Service"]["LimitRTPRIO"][0])


def test_a_stop_of_the_unit_leaves_the_watchdog_its_time() -> None:
    service = unit(DEPLOY / "acsar-run.service")["Service"]
    assert service["KillMode"] == ["control-group"]
    assert service["KillSignal"] == ["SIGTERM"]
    assert "SIGTERM" in IGNORED_SIGNALS
    assert int(service["TimeoutStopSec"][0]) >= 5
    assert service["Restart"] == ["no"]
    assert "PrivateTmp" not in service  # acsar-gym estop listens in /tmp


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_systemd_knows_all_that_a_unit_says(path: Path, tmp_path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for wrong, message in (("", ""), ("NoSuchOption=yes\n", "Unknown")):
        here = text.replace(PLACE, sys.executable).replace("[Service]\n", f"[Service]\n{wrong}")
        copy = tmp_path / path.name
        copy.write_text(here, encoding="utf-8")
        done = subprocess.run(
            ["systemd-analyze", "verify", copy], capture_output=True, text=True, check=False
        )
        said = [line for line in done.stderr.splitlines() if path.name in line]
        assert message in done.stderr
        assert bool(said) == bool(wrong), said


def test_the_images_install_extras_that_there_are() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (DEPLOY / "Dockerfile").read_text(encoding="utf-8")
    extras = re.findall(r"^ARG EXTRAS=(\S+)", text, re.M)[0].split(",")
    assert {"deploy", *extras} <= set(project["optional-dependencies"])


def test_udev_finds_no_fault_in_the_rules() -> None:
    assert 'SYMLINK+="acsar"' in RULES.read_text(encoding="utf-8")
    if shutil.which("udevadm") is None:
        pytest.skip("needs udevadm")
    done = subprocess.run(["udevadm", "verify", RULES], capture_output=True, text=True, check=False)
    if "Unknown command" in done.stderr:
        pytest.skip("needs udevadm of systemd 254 or newer")
    assert done.returncode == 0, done.stderr


AS_USER = () if os.geteuid() == 0 else ("--user", "--map-current-user")
CONTAINER = ("unshare", *AS_USER, "--pid", "--fork", "--kill-child")
"""A PID namespace: what ends its first process kills all others, as in a container."""


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_program_s_end_in_a_container_leaves_the_wheels_stopped(
    number: signal.Signals, emulator: Emulated
) -> None:
    has_unshare = shutil.which("unshare") is not None
    if not has_unshare or subprocess.run([*CONTAINER, "true"], check=False).returncode:
        pytest.skip("needs a PID namespace")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    words = ("drive", "--link", emulator.device, "--linear", "0.2")
    with subprocess.Popen(
        [*CONTAINER, DEPLOY / "entrypoint.sh", *words],
        env={**os.environ, "PATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as container:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        inside = psutil.Process(container.pid).children(recursive=True)
        (program,) = (
            one
            for one in inside
            if one.cmdline()[-len(words) :] == list(words)
            and "entrypoint" not in " ".join(one.cmdline())
        )
        program.send_signal(number)
        assert container.wait(TIMEOUT) == 128 + number
    wait_until(emulator.is_stopped, "zero as the last command")
