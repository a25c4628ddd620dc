"""The preset `acsar_avr` answers as the board's program does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from firmware_tools import CHIPS, QUANTUM, Script, Stamped, decoded

from acsar_gym import RobotConfig
from acsar_gym.physics.firmware import Firmware
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import Speeds, encode

MS = 0.001
SECONDS = 12.0


class Twin:
    """The preset's firmware and wheels, in steps of 1 ms."""

    def __init__(self) -> None:
        config = RobotConfig.preset("acsar_avr")
        self._body = PlanarBody(config)
        self._firmware = Firmware(config, self._body)
        self.speeds: list[Speeds] = []
        self.sent: list[Stamped] = []

    def run(self, end: float, said: list[Stamped]) -> None:
        """Send it the same bytes at the same times."""
        waiting = list(said)
        for step in range(round(end / MS)):
            now = step * MS
            while waiting and waiting[0][0] < now + MS - 1e-9:
                time, data = waiting.pop(0)
                self._advance(now, time)
                self._firmware.receive(data)
                now = time
            self._advance(now, (step + 1) * MS)
            self.speeds.append(self._body.wheel_speeds)

    def _advance(self, now: float, until: float) -> None:
        data = self._firmware.advance(until - now)
        if data:
            self.sent.append((until, data))


def steps(script: Script, seed: int, most: float) -> None:
    """New random speeds every 0.4 s, and a stop now and then."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 0.01)
    speeds = np.zeros(4)
    for tick in range(round(SECONDS * 100)):
        if tick % 40 == 0:
            speeds = rng.uniform(-most, most, 4) if tick % 200 < 160 else np.zeros(4)
        script.say(tick / 100 + phase, encode(speeds.tolist()))


@pytest.mark.parametrize(("seed", "most"), [(0, 12.0), (1, 28.0), (2, 2.0)])
def test_twin_agrees_through_steps_and_reversals(
    chip: str, tmp_path: Path, seed: int, most: float
) -> None:
    script = Script(chip)
    twin = Twin()
    steps(script, seed, most)
    ran = script.run(SECONDS + 1.0, tmp_path)
    twin.run(SECONDS + 1.0, script.sent)
    states = ran.states("speeds")
    times = [min(round(time / MS) - 1, len(twin.speeds) - 1) for time, _ in states]
    true = np.array([speeds for _, speeds in states])
    assert np.abs(true - np.array(twin.speeds)[times]).max() < QUANTUM

    board = ran.feedback()
    expected = decoded(twin.sent)
    assert abs(len(board) - len(expected)) <= 1
    pairs = list(zip(board, expected, strict=False))
    assert max(abs(sent[0] - simulated[0]) for sent, simulated in pairs) < 2.0 * MS
    quanta = np.array([np.subtract(sent[1], simulated[1]) for sent, simulated in pairs]) / QUANTUM
    # Both round to whole counts of the encoders, at slightly different moments.
    assert np.abs(quanta).max() < 2.2
    assert (np.abs(quanta) < 1.2).mean() > 0.99


@pytest.mark.parametrize("chip", CHIPS[:1])
def test_speed_loops_hold_wheels_that_are_stronger_or_weaker(chip: str, tmp_path: Path) -> None:
    script = Script(chip, ("--gain", "1.1,0.85,0.95,1.2", "--lag", "0.08,0.1,0.07,0.09"))
    speeds = (10.0, -4.0, 1.0, -0.3)
    script.command(0.1, 3.0, speeds)
    ran = script.run(3.0, tmp_path)
    for _, true in ran.states("speeds")[-200:]:
        assert true == pytest.approx(speeds, abs=QUANTUM)
    mean = np.mean([line for _, line in ran.feedback()[-100:]], axis=0)
    assert mean == pytest.approx(speeds, abs=0.01)
