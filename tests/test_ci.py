"""Which Python `make` takes, and what it says before PyBullet is compiled."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FAKE = '#!/bin/sh\n[ "$1" = -c ] && {{ echo {version}; exit; }}\necho "$0 $*" >>{log}\n'
"""A Python that tells its version, and notes what else it is asked to do."""
BROKEN = "#!/bin/sh\nexit 127\n"
"""What pyenv offers of a version that isn't chosen."""


def make_environment(
    tmp_path: Path, asked: str = "", **programs: str
) -> tuple[subprocess.CompletedProcess[str], str]:
    """Run .ci/venv where only these programs are; returns what came of it, and what was asked."""
    log = tmp_path / "log"
    log.touch()
    for name, version in programs.items():
        program = tmp_path / name.replace("_", ".").replace("cxx", "c++")
        program.write_text(FAKE.format(version=version, log=log) if version else BROKEN)
        program.chmod(0o755)
    command = ["/bin/sh", str(ROOT / ".ci" / "venv"), "new", *([asked] if asked else [])]
    done = subprocess.run(
        command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    return done, log.read_text().replace(f"{tmp_path}/", "")


@pytest.mark.parametrize(
    ("programs", "asked"),
    [
        ({"python3": "3.13", "python3_11": "3.11", "uv": "0"}, "python3.11 -m venv new"),
        (
            {"python3": "3.12", "python3_11": "", "uv": "0"},
            "uv venv --quiet --seed --python 3.11 new",
        ),
        ({"python3": "3.12", "cxx": "0"}, "python3 -m venv new"),
        ({"python3": "3.11"}, "python3 -m venv new"),
    ],
    ids=["3.11", "uv", "another", "3.11 by another name"],
)
def test_python_3_11_is_taken_where_it_can_be_had(
    programs: dict[str, str], asked: str, tmp_path: Path
) -> None:
    done, noted = make_environment(tmp_path, **programs)
    assert (done.returncode, noted.strip()) == (0, asked)
    assert ("compiles" in done.stdout) == (programs["python3"] == "3.12" and "uv" not in programs)


def test_a_named_python_is_taken(tmp_path: Path) -> None:
    done, noted = make_environment(
        tmp_path, "python3.13", python3_11="3.11", python3_13="3.13", cxx="0"
    )
    assert (done.returncode, noted.strip()) == (0, "python3.13 -m venv new")
    assert "no wheel for Python 3.13" in done.stdout
    assert "ten minutes" in done.stdout


@pytest.mark.parametrize(
    ("programs", "told"),
    [
        ({"python3": "3.12"}, "there is no C++ compiler: apt install g++"),
        ({"python3": "3.10"}, "python3 is Python 3.10: install Python 3.11 to 3.13"),
        ({}, "no python3 here: install Python 3.11 to 3.13"),
    ],
    ids=["no compiler", "too old", "none"],
)
def test_what_is_missing_is_one_line(programs: dict[str, str], told: str, tmp_path: Path) -> None:
    done, noted = make_environment(tmp_path, **programs)
    assert (done.returncode, noted) == (2, "")
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("make: ")]
    assert told in line
