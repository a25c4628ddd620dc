from __future__ import annotations

import sys
from pathlib import Path

import pytest
from cli_tools import Ended, assert_one_line

from acsar_gym.tools.cli import main


class CommandLine:
    """`call(LINE, ARGUMENTS)` runs `acsar-gym ...` in this process: many calls are faster so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch = monkeypatch
        self._capsys = capsys

    def __call__(self, line: str = "", *arguments: str | Path) -> Ended:
        words = ["acsar-gym", *line.split(), *map(str, arguments)]
        self._monkeypatch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *self._capsys.readouterr()

    def succeed(self, line: str, *arguments: str | Path) -> str:
        """Return the standard output of a call that writes nothing to standard error."""
        code, out, error = self(line, *arguments)
        assert (code, error) == (0, "")
        return out

    def refuse(self, message: str, line: str, *arguments: str | Path, code: int = 2) -> str:
        """Return the standard output of a call that ends with one line, with a message."""
        status, out, error = self(line, *arguments)
        assert status == code, error
        assert_one_line(error, message)
        return out


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(monkeypatch, capsys)
