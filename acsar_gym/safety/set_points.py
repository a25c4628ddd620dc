"""Finds boards that send back what was commanded, instead of what their encoders measure."""

from __future__ import annotations

from collections import deque

from acsar_gym.errors import LinkError
from acsar_gym.protocol import MAX_SPEED, Reading, Speeds

MOST_EQUAL, MOST_ALONE = 12, 6
"""So many commands that come back to the last digit, in order, are no measurements, and so many
where nothing else comes between: a wheel that follows a ramp has its lag, and four of them don't
have it to 0.01 rad/s."""
LEAST_CHANGE, MOST_SKIPPED = 0.2, 5
"""These commands differ by so much [rad/s], with so few others between: wheels that follow slow
changes do pass each commanded speed. A board may send fewer lines than it gets."""
MAX_COMMANDS = 100  # commands that are compared, the newest ones
LONGEST_REST = 50
"""After so many lines of wheels that stand, what was equal before doesn't count: simulated wheels
that start again and again pass a few commanded speeds each time."""


class SetPointWatch:
    """Compares feedback with the commands before it."""

    def __init__(self, *, echoes: bool) -> None:
        self._echoes = echoes
        self._sent: deque[tuple[float | None, ...]] = deque(maxlen=MAX_COMMANDS)
        self._newest: tuple[float, ...] = ()
        self._counted: tuple[float | None, ...] = ()
        self._equal = self._alone = self._passed = self._rested = 0

    def note(self, speeds: Speeds) -> None:
        """Take a new command."""
        a, b, c, d = (round(min(max(speed, -MAX_SPEED), MAX_SPEED), 2) for speed in speeds)
        if (a, b, c, d) != self._newest:
            self._newest = a, b, c, d
            self._sent.append(self._newest)

    def check(self, reading: Reading) -> None:
        """Take a line of feedback.

        Raises:
            LinkError: it was the last of so many that were commands that no more are needed.
        """
        speeds = reading.speeds
        self._rested = 0 if any(speeds) else self._rested + 1
        if self._rested > LONGEST_REST:
            self._equal = 0
        if speeds not in self._sent:
            self._alone = 0
            return
        skipped = self._sent.index(speeds)
        for _ in range(skipped):
            self._sent.popleft()
        self._passed += skipped
        pairs = zip(speeds, self._counted, strict=False)
        change = max((abs((now or 0.0) - (then or 0.0)) for now, then in pairs), default=0.0)
        if change >= LEAST_CHANGE and self._passed <= MOST_SKIPPED:
            self._equal, self._alone = self._equal + 1, self._alone + 1
        elif self._passed > MOST_SKIPPED or not self._counted:
            self._equal = self._alone = 0
        else:
            return
        self._counted, self._passed = speeds, 0
        if self._equal < MOST_EQUAL and self._alone < MOST_ALONE:
            return
        if self._echoes:
            raise LinkError(
                "this board echoes, and its feedback is what was commanded, too, to the last digit",
                "its program must send the speeds that its encoders measure",
            )
        raise LinkError(
            f"this board echoes, or sends its set points: {self._equal} commands came back in "
            "order, to the last digit",
            "write echo: true into the robot's file if it also sends the speeds that its encoders "
            "measure, otherwise mend its program ('acsar-gym doctor DEVICE --spin')",
        )
