"""`identify` finds in the board's answers what its config.h says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from firmware_tools import CHIPS, QUANTUM, Script

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.excitation import plan_excitation
from acsar_gym.tools.sysid.identify import identify_logs

SECONDS = 20.0
TICK = 0.01013
"""As the manoeuvre's own, so that commands come at every phase of the board's loops [s]."""


def test_identify_finds_what_config_h_says(tmp_path: Path) -> None:
    script = Script(CHIPS[0])
    config = RobotConfig.preset("acsar_avr").with_(motor={"time_constant": 0.05})
    plan = plan_excitation(config, SECONDS, TICK)
    ticks = [*plan.first.tolist(), *[None] * plan.pause, *plan.last.tolist()]
    for number, speeds in enumerate(ticks):
        if speeds is not None:
            script.say(0.5 + number * TICK, encode(speeds))

    ran = script.run(0.5 + len(ticks) * TICK, tmp_path)
    got = [(event["t"], event["tx"].encode("latin-1")) for event in ran.events if "tx" in event]
    log = WireLog(
        np.array([time for time, _ in script.sent]),
        tuple(data for _, data in script.sent),
        np.array([time for time, _ in got]),
        tuple(data for _, data in got),
    )

    result = identify_logs([log], config)
    values = {(finding.name, finding.wheel): finding.value for finding in result.findings}
    for wheel in "abcd":
        name = "motor.time_constant"  # one value for all wheels where they agree
        lag = values.get((name, wheel), values.get((name, "")))
        assert lag == pytest.approx(0.08, rel=0.05)
    shared_values = {name: value for (name, wheel), value in values.items() if not wheel}
    assert shared_values["motor.gain"] == pytest.approx(1.0, abs=0.01)
    assert shared_values["motor.acceleration"] == pytest.approx(60.0, rel=0.1)
    assert shared_values["firmware.command_delay"] == pytest.approx(0.0, abs=0.005)
    assert shared_values["firmware.command_timeout"] == pytest.approx(0.5, abs=0.06)
    assert shared_values["firmware.feedback_rate"] == pytest.approx(100.0, rel=0.01)
    assert shared_values["encoder.quantum"] == pytest.approx(QUANTUM, abs=0.005)
