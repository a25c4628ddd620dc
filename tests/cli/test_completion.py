"""`acsar-gym completion` and `acsar-gym --version`."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli_tools import Call

import acsar_gym
from acsar_gym.tools.cli import COMMANDS

TYPED = """
source "$1"; shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
_tyro_acsar_gym
printf '%s\\n' "${COMPREPLY[@]}"
"""
HEAVY = """
import sys
from acsar_gym.tools.cli import app
sys.argv = ["acsar-gym", "completion", "bash"]
try:
    app.main()
finally:
    found = {"torch", "ray", "dash", "pybullet"} & set(sys.modules)
    print(sorted(found), file=sys.stderr)
"""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_for_each_shell_knows_every_command(call: Call, shell: str) -> None:
    code, script, error = call("completion", shell)
    assert (code, error) == (0, "")
    assert [name for name in COMMANDS if name not in script] == []
    assert "learning-rate" in script  # of train, which parses its own options
    assert "difficulty" in script  # of worlds show


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (("ev",), ["evaluate"]),
        (("worlds", "ch"), ["check"]),
        (("train", "--lear"), ["--learning-rate"]),
        (("record", "export", "drive.mcap", "--to", "p"), ["parquet"]),
        (("worlds", "show", "--diff"), ["--difficulty"]),
        (("nosuch", "x"), []),
    ],
)
def test_bash_completes(
    call: Call, tmp_path: Path, words: tuple[str, ...], completed: list[str]
) -> None:
    file = tmp_path / "acsar-gym"
    file.write_text(call("completion", "bash")[1])
    command = ["bash", "-c", TYPED, "bash", str(file), "acsar-gym", *words]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said.split() == completed


def test_it_imports_nothing_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", HEAVY], check=True, capture_output=True, text=True)
    assert done.stderr == "[]\n"


def test_the_version(call: Call) -> None:
    assert call("--version") == (0, f"acsar-gym {acsar_gym.__version__}\n", "")
