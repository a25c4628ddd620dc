"""No command of ours, and no library that it uses, connects to another computer or asks for one.

Commands run under strace, which sees what C++ libraries and child processes do, too.
"""

from __future__ import annotations

import ipaddress
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from recording_tools import record_drive

pytestmark = pytest.mark.slow

TIMEOUT = 900.0
"""Longest duration of a command, whose loops may have to be compiled on a busy machine [s]."""
TRACE = ("strace", "-f", "--seccomp-bpf", "-e", "trace=%network")
CALL = re.compile(r"\b(connect|sendto|sendmsg|sendmmsg)\(")
ADDRESS = re.compile(
    r"sin6?_port=htons\((\d+)\).*?(?:inet_addr\(|inet_pton\(AF_INET6, )\"([^\"]+)\""
)
QUIETING = ("CI", "GITHUB_ACTIONS", "TF_BUILD", "ORT_DISABLE_TELEMETRY", "RAY_USAGE_STATS_ENABLED")
"""Variables by which libraries stay silent. A user's shell doesn't have them."""


def outside(trace: Path) -> list[str]:
    """Calls of a trace that reach out: to other addresses, or for a name to a resolver."""
    reaching = []
    for line in trace.read_text(errors="replace").splitlines():
        if CALL.search(line) is None:
            continue
        if "AF_UNIX" in line and "resolve" in line:
            reaching.append(line)
        for port, address in ADDRESS.findall(line):
            ip = ipaddress.ip_address(address)
            ip = getattr(ip, "ipv4_mapped", None) or ip
            if port == "53" or not ip.is_loopback:
                reaching.append(line)
    return reaching


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home of its own for a user who has silenced nothing. Commands run beside it."""
    folder = tmp_path / "home"
    folder.mkdir()
    record_drive(tmp_path / "a.mcap", [(0.2, 0.0, 20)])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    for name in QUIETING:
        monkeypatch.delenv(name, raising=False)
    return folder


@pytest.fixture
def trace(home: Path) -> Path:
    """The file of a trace, after a proof that connections are seen."""
    file = home.parent / "trace"
    if shutil.which("strace") is None:
        pytest.skip("strace isn't installed")
    reach = (
        "import socket as s; p = s.socket(s.AF_INET, s.SOCK_DGRAM);"
        "p.connect(('127.0.0.1', 9)); p.connect_ex(('192.0.2.1', 9))"
    )
    traced = [*TRACE, "-o", str(file), sys.executable, "-c", reach]
    done = subprocess.run(traced, check=False, capture_output=True, text=True, timeout=TIMEOUT)
    if done.returncode != 0:
        pytest.skip(f"strace can't trace here: {done.stderr.strip()[:200]}")
    assert [ADDRESS.findall(line) for line in outside(file)] == [[("9", "192.0.2.1")]]
    return file


COMMANDS = {
    "train --env point_goal --steps 1 --robots 4 --threads 1 --net 8 --no-progress --out run": (
        "next: acsar-gym evaluate"
    ),
    "evaluate --policy point_goal --episodes 2 --workers 2 --json figures.json": (
        "point_goal, seeds 0 to 1"
    ),
    "benchmark --sets open/acsar --agents packaged turn_drive --links planar --scenes 2 "
    "--workers 2 --out bench --html bench.html": "written: bench",
    "view a.mcap --save a.rrd": "a.rrd: 1 episode, for Rerun's viewer",
    "demo --steps 4096 --episodes 2 --out demo": "serial device (emulator)",
}
"""Commands, with options that make them short, and what they print when they have done all. Their
exit code also depends on late ticks, and on goals that a policy of few steps misses."""


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: words.split(" ")[0])
def test_commands_connect_to_no_other_computer(words: str, trace: Path, home: Path) -> None:
    traced = [*TRACE, "-o", str(trace), sys.executable, "-m", "acsar_gym", *words.split()]
    done = subprocess.run(traced, check=False, capture_output=True, text=True, timeout=TIMEOUT)
    assert COMMANDS[words] in done.stdout, done.stderr
    assert outside(trace) == []
    # No program left a number for this computer.
    files = [str(path.relative_to(home)) for path in home.rglob("*") if path.is_file()]
    assert [name for name in files if not name.startswith((".cache/matplotlib/", ".config/"))] == []
