"""README's section on other libraries: its blocks of code, run as they stand but for their size."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def snippets() -> dict[str, tuple[str, str]]:
    """Language and code of each block, by the first word of its first line."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text.split("### Train with your own library\n")[1].split("\n### ")[0]
    blocks = re.findall(
        r"^```(\w+)\n# ([\w. -]+?)(?=[:\n])(.*?)^```", section, re.MULTILINE | re.DOTALL
    )
    return {name: (language, f"#{code}") for language, name, code in blocks}


def shrunk(name: str, smaller: Mapping[str, str]) -> str:
    """A block's code, with other numbers."""
    _, code = snippets()[name]
    for old, new in smaller.items():
        assert old in code, old
        code = code.replace(old, new)
    return code


def run(name: str, smaller: Mapping[str, str], folder: Path) -> str:
    """Run a block in a process of its own, in a folder; returns what it printed."""
    code = shrunk(name, smaller)
    python = snippets()[name][0] == "python"
    command = [sys.executable, "-c", code] if python else ["bash", "-ec", code]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | {"PATH": path, "RAY_AUTH_MODE": "disabled", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr
