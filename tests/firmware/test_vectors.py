"""docs/protocol-vectors.json against the program, in the way that docs/protocol.md says."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import protocol_tools

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_vectors_pass_the_two_programs_of_the_page(tmp_path: Path) -> None:
    page = (DOCS / "protocol.md").read_text(encoding="utf-8")
    vectors = (DOCS / "protocol-vectors.json").read_text(encoding="ascii")
    (tmp_path / "protocol-vectors.json").write_text(vectors)
    for name in ("make_vectors.py", "check.c"):
        (code,) = re.findall(rf"^```\w+\n(?:# |/\* ){name}.*?\n(.*?)^```", page, re.M | re.S)
        (tmp_path / name).write_text(code)
    subprocess.run([sys.executable, "make_vectors.py"], cwd=tmp_path, check=True)
    source = protocol_tools.SOURCE
    options = [*protocol_tools.STRICT, "-I", str(source.parent)]
    build = ["cc", *options, "check.c", str(source), "-o", "check"]
    subprocess.run(build, cwd=tmp_path, check=True)
    ran = subprocess.run(["./check"], cwd=tmp_path, check=True, capture_output=True, text=True)
    read = json.loads(vectors)
    assert ran.stdout == f"{len(read['encode']) + len(read['decode'])} vectors, 0 failed\n"
