"""Real-time priority and pinning to cores, allowed and refused."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.commission.host import prepare_realtime

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
    ("arguments", "user", "message"),
    [
        ((95,), 1000, "@realtime - rtprio 96' into /etc/security/limits.d/"),
        ((50,), 0, "--cap-add SYS_NICE"),
        ((99,), 0, "must be 1 to 98"),
        *(((None, cores), 0, "--cores") for cores in ([], [-1], [0, 10**6], [10**30])),
        ((50,), None, "this operating system"),
        ((None, [0]), None, "this operating system"),
    ],
)
def test_prepare_realtime_explains_a_refusal_in_a_line(
    arguments: tuple[Any, ...], user: int | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`user` None is another operating system."""

    def refuse(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    cores = os.sched_getaffinity(0)
    with monkeypatch.context() as patch:
        if user is None:
            patch.delattr(os, "sched_setscheduler")
            patch.delattr(os, "sched_setaffinity")
        else:
            patch.setattr(os, "sched_setscheduler", refuse)
            patch.setattr(os, "geteuid", lambda: user)
        with pytest.raises(ConfigError) as caught:
            prepare_realtime(*arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert os.sched_getaffinity(0) == cores


@linux
def test_prepare_realtime_leaves_room_above_for_the_watchdog(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    priorities: list[int] = []
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda _, __, param: priorities.append(param.sched_priority)
    )
    prepare_realtime(50)
    assert priorities == [51, 50]
    done = subprocess.run(
        [sys.executable, "-c", PREPARE], capture_output=True, text=True, timeout=60, check=True
    )
    printed = done.stdout.strip()
    assert printed == "prepared True 20 1" or "run without --realtime" in printed
