"""`evaluate --workers` and `--address`, where they can't be used."""

from __future__ import annotations

import pytest
from cli_tools import Call, assert_one_line

from acsar_gym.tools.jobs import cluster


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("--workers 0 --link planar", 2, "--workers 0: must be 1 to"),
        ("--workers 2 --link /dev/ttyUSB7", 2, "one process drives one robot"),
        ("--address auto --link replay:old.mcap", 2, "one process drives one robot"),
        ("--address nowhere --link planar", 2, "must be local, auto, host:port"),
        ("--address 127.0.0.1:1 --link planar", 3, "'127.0.0.1:1': doesn't answer"),
    ],
)
def test_one_line_says_what_is_wrong(
    call: Call, monkeypatch: pytest.MonkeyPatch, arguments: str, code: int, said: str
) -> None:
    monkeypatch.setattr(cluster, "CLUSTER_TIMEOUT", 0.1)
    ended, _, error = call("evaluate", *arguments.split())
    assert ended == code
    assert_one_line(error, said)
