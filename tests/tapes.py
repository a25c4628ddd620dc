"""Recordings to play back."""

from __future__ import annotations

import json
from pathlib import Path

from acsar_gym import RobotConfig, open_link
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

PERIOD = 0.01
TICKS = 310
"""Periods of a tape: 10 at rest, then the wheels turn."""
TURNING = encode((3.0, 3.0, 3.0, 3.0))


def taped(path: Path, config: RobotConfig) -> Path:
    """The planar robot, recorded: it stands, then its wheels turn."""
    link = open_link("planar", config)
    link.open()
    link.reset(Scene())
    events: list[dict[str, object]] = [{"reset": link.now()}]
    for tick in range(TICKS):
        command = encode(ZERO) if tick < 10 else TURNING
        link.write(command)
        got = link.advance(PERIOD)
        events.append({"sent": command.decode(), "got": got.decode(), "t": link.now()})
    link.close()
    path.write_text("".join(json.dumps(event) + "\n" for event in events), encoding="ascii")
    return path
