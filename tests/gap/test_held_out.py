"""Robots with hidden parameters: identified from one log, and replayed on others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rollout_tools import driven, random_steps, recording

from acsar_gym import RobotConfig
from acsar_gym.tools.sysid.identify import identify_logs
from acsar_gym.tools.sysid.twin_gap import TwinGap, measure_gap, pool_figures

ACSAR = RobotConfig.preset("acsar")
ROBOTS = 6
DURATION = 20.0
"""Of each log [s]."""
HELD_OUT = 3
"""Logs of each robot that it isn't fitted to."""


def hidden(rng: np.random.Generator) -> dict[str, Any]:
    """Parameters of a robot that differs from the default one."""
    motor = {
        "time_constant": float(rng.uniform(0.05, 0.18)),
        "gain": float(rng.uniform(0.9, 1.1)),
        "deadband": float(rng.uniform(0.0, 0.5)),
        "acceleration": float(rng.uniform(30.0, 80.0)),
    }
    rate = float(rng.choice([20.0, 25.0, 50.0, 100.0]))
    delay = float(rng.uniform(0.0, 0.03))
    return {"motor": motor, "firmware": {"feedback_rate": rate, "command_delay": delay}}


def gap_of(seed: int) -> TwinGap:
    """Fit a hidden robot to one log, and measure its gap on the others."""
    rng = np.random.default_rng(seed)
    robot = ACSAR.with_(**hidden(rng))
    known = ACSAR.with_(firmware={"feedback_rate": robot.feedback_rate})
    logs = []
    for number in range(1 + HELD_OUT):
        steps = random_steps(10 * seed + number, DURATION, robot)
        episode = driven(robot, steps, phase=float(rng.uniform(0.0, 0.05)))
        logs.append((f"{number}", recording(known, episode, name=f"{seed} {number}")))
    first = logs[0][1]
    fitted = identify_logs([one.wire for one in first.episodes], known, [first.sha256]).robot()
    return measure_gap(logs, ("fitted", fitted), ("acsar", ACSAR))


@pytest.mark.slow
def test_fitted_twins_have_a_tenth_of_the_gap_on_held_out_logs() -> None:
    judged = [replay for seed in range(ROBOTS) for replay in gap_of(seed).judged]
    assert len(judged) == ROBOTS * HELD_OUT
    seconds = [replay.seconds for replay in judged]
    before, after = (
        pool_figures([replay.figures[side] for replay in judged], seconds)
        for side in ("before", "after")
    )
    assert after["wheel_speed_rms"] <= 0.1 * before["wheel_speed_rms"]
    assert after["end_pose"] <= 0.1 * before["end_pose"]
    assert abs(after["time_shift"]) < 0.005
