"""Real-time priority and pinning to cores, allowed and refused."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.commission import host as realtime

linux = pytest.mark.skipif(
    not hasattr(os, "sched_setscheduler"), reason="this system has no SCHED_FIFO"
)
PREPARE = """
import os, sys
from acsar_gym.errors import ConfigError
from acsar_gym.tools.commission.host import prepare_realtime
try:
    prepare_realtime(20, [min(os.sched_getaffinity(0))])
except ConfigError as error:
    print(error)
else:
    print("prepared", os.sched_getscheduler(0) == os.SCHED_FIFO,
          os.sched_getparam(0).sched_priority, len(os.sched_getaffinity(0)))
"""


@linux
@pytest.mark.parametrize(
    ("arguments", "user", "said"),
    [
        ((50,), 1000, "@realtime - rtprio 90' into /etc/security/limits.d/"),
        ((95,), 1000, "@realtime - rtprio 96'"),
        ((50,), 0, "--cap-add SYS_NICE"),
        ((0,), 1000, "must be 1 to 98"),
        ((99,), 0, "must be 1 to 98"),
        *(((None, cores), 0, "--cores") for cores in ([], [-1], [0, 10**6], [10**30])),
        ((50,), None, "this operating system"),
        ((None, [0]), None, "this operating system"),
    ],
)
def test_what_cannot_be_had_is_one_line(
    arguments: tuple[Any, ...], user: int | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`user` None is another operating system."""

    def scheduler(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    before = os.sched_getaffinity(0)
    with monkeypatch.context() as patch:
        if user is None:
            patch.delattr(os, "sched_setscheduler")
            patch.delattr(os, "sched_setaffinity")
        else:
            patch.setattr(os, "sched_setscheduler", scheduler)
            patch.setattr(os, "geteuid", lambda: user)
        with pytest.raises(ConfigError) as caught:
            realtime.prepare_realtime(*arguments)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert os.sched_getaffinity(0) == before


@linux
def test_in_a_process_of_its_own_with_room_above_for_the_watchdog(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda _, __, param: asked.append(param.sched_priority)
    )
    realtime.prepare_realtime(50)
    assert asked == [51, 50]
    done = subprocess.run(
        [sys.executable, "-c", PREPARE], capture_output=True, text=True, timeout=60, check=True
    )
    said = done.stdout.strip()
    assert said == "prepared True 20 1" or "run without --realtime" in said
