"""The stop button: the same emergency stop as `acsar-gym estop`, for one process."""

from __future__ import annotations

import time
from dataclasses import dataclass

from acsar_gym.errors import LinkError
from acsar_gym.safety import estop


@dataclass(frozen=True)
class Stop:
    """What came of a stop.

    Attributes: `state`, "stopped", "unanswered" or "nobody"; `said`, in words.
    """

    state: str
    said: str


def can_stop(process: int) -> bool:
    """Whether a process listens for a stop: programs that drive a real robot do."""
    try:
        return process > 0 and estop.listens(process)
    except LinkError:
        return False


def stop(process: int) -> Stop:
    """Ask the process that drives to stop the robot, and wait until it says that it has.

    Its control loop answers once zero was written to the wire, and goes on commanding zero until
    somebody releases it, whatever the program resets. Where it doesn't answer, its watchdog process
    commands zero on its own. Nobody else is asked, so that nobody else's silence counts.

    Args:
        process: its id.
    """
    began = time.monotonic()
    try:
        found = estop.stop_all(process=process) if process else []
    except LinkError as error:
        return Stop("unanswered", str(error))
    took = (time.monotonic() - began) * 1e3
    answered = bool(found) and all(each.answered for each in found)
    if not (answered or can_stop(process)):
        return Stop(
            "nobody",
            "nothing to stop: the program has ended, and it or its watchdog stops the wheels",
        )
    if not answered:
        return Stop("unanswered", "the program doesn't answer: its watchdog stops the wheels")
    if not all(each.connected for each in found):
        return Stop("stopped", "the program isn't connected to the robot, and won't drive it")
    clock = time.strftime("%H:%M:%S")
    said = f"zero is on the wire, says the control loop (after {took:.0f} ms, at {clock})"
    return Stop("stopped", f"{said}, until acsar-gym estop --release")
