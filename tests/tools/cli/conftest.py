from __future__ import annotations

import sys
from pathlib import Path

import pytest
from cli_tools import Call, Ended

from acsar_gym.tools.cli import main


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """`acsar-gym ARGUMENTS` in this process: many calls are faster so."""

    def run(*arguments: str | Path) -> Ended:
        monkeypatch.setattr(sys, "argv", ["acsar-gym", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *capsys.readouterr()

    return run
