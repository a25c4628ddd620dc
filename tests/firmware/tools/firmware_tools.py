"""The board's program, built by avr-gcc, and its simulated chip: see tests/firmware/board."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acsar_gym.protocol import Decoder, Speeds, encode
from acsar_gym.resources import ASSETS

ROOT = Path(__file__).resolve().parents[3]
BUILD = ROOT / "build" / "firmware"
CHIPS = ("atmega328p", "atmega2560")
QUANTUM = 2.0 * math.pi / 1320 / 0.05
"""Speed of one encoder count in the feedback's window [rad/s]."""

Stamped = tuple[float, bytes]


def missing() -> str:
    """What isn't installed. Empty if all is there."""
    if not shutil.which("avr-gcc"):
        return "avr-gcc (Debian: gcc-avr, avr-libc)"
    if not Path("/usr/include/simavr/sim_avr.h").exists() or not shutil.which("cc"):
        return "simavr's library (Debian: libsimavr-dev, gcc)"
    return ""


def build() -> None:
    """Build the program for both chips, and the simulated board."""
    for folder in (ASSETS / "firmware", ROOT / "tests" / "firmware" / "board"):
        subprocess.run(
            ["make", "-s", "-C", str(folder), f"BUILD={BUILD}"], check=True, stdout=subprocess.PIPE
        )


def command(chip: str, elf: Path | None = None) -> tuple[str, ...]:
    """Command of a simulated board, with the program as it is or another one."""
    return str(BUILD / "avr_board"), chip, str(elf or BUILD / f"{chip}.elf")


def build_changed(folder: Path, chip: str, **changes: str) -> tuple[Path, str]:
    """Build the program with other numbers in config.h. Returns the ELF and the warnings."""
    source = folder / "firmware"
    shutil.copytree(ASSETS / "firmware", source, dirs_exist_ok=True)
    config = source / "acsar" / "config.h"
    text = config.read_text()
    for name, value in changes.items():
        text, count = re.subn(rf"#define {name} .*", f"#define {name} {value}", text)
        assert count == 1
    config.write_text(text)
    elf = source / "build" / f"{chip}.elf"
    made = ["make", "-s", "-C", str(source), f"build/{chip}.elf"]
    return elf, subprocess.run(made, check=False, capture_output=True, text=True).stderr


@dataclass
class Script:
    """What happens to a board, in simulated time [s]."""

    chip: str
    options: tuple[str, ...] = ()
    elf: Path | None = None
    _lines: list[tuple[float, str]] = field(default_factory=list)

    def say(self, time: float, data: bytes) -> None:
        """Begin to send bytes to it."""
        self._lines.append((time, f"send {data.hex()}"))

    def order(self, time: float, order: str) -> None:
        """Give an order of tests/firmware/board/main.c, such as hang or `turn WHEEL SPEED`."""
        self._lines.append((time, order))

    def command(self, start: float, end: float, speeds: Speeds, rate: float = 100.0) -> None:
        """Command wheel speeds [rad/s] at a rate [Hz]."""
        for tick in range(round((end - start) * rate)):
            self.say(start + tick / rate, encode(speeds))

    @property
    def sent(self) -> list[Stamped]:
        """All bytes to the board, in order."""
        sends = (line for line in sorted(self._lines) if line[1].startswith("send"))
        return [(time, bytes.fromhex(order[5:])) for time, order in sends]

    def run(self, end: float, folder: Path) -> Ran:
        """Run until a time [s]."""
        log = folder / "log.jsonl"
        lines = [*sorted(self._lines), (end, "end")]
        subprocess.run(
            [*command(self.chip, self.elf), "--script", "--log", str(log), *self.options],
            input="".join(f"{time:.6f} {order}\n" for time, order in lines),
            text=True,
            check=True,
        )
        return Ran([json.loads(line) for line in log.read_text().splitlines()])


@dataclass
class Ran:
    """The log of a script."""

    events: list[dict[str, Any]]

    @property
    def figures(self) -> dict[str, Any]:
        """Resets, stack and load."""
        return self.events[-1]

    def feedback(self) -> list[tuple[float, Speeds]]:
        """Time and speeds of each line. All lines are whole."""
        return decoded(self._sent())

    def notes(self) -> list[str]:
        """What the board has said in text."""
        lines = b"".join(data for _, data in self._sent()).split(b"\r\n")
        return [line.decode("ascii") for line in lines if line.startswith(b"#")]

    def _sent(self) -> list[Stamped]:
        return [(e["t"], e["tx"].encode("latin-1")) for e in self.events if "tx" in e]

    def states(self, name: str) -> list[tuple[float, list[float]]]:
        """Times, and true "speeds" [rad/s] or "duty" (-1 to 1) of the wheels."""
        return [(e["t"], e[name]) for e in self.events if name in e]

    def at(self, time: float, name: str) -> list[float]:
        """A state at a time [s]."""
        return next(value for stamp, value in self.states(name) if stamp >= time)


def decoded(chunks: Iterable[Stamped]) -> list[tuple[float, Speeds]]:
    """Lines with the time of their last chunk."""
    decoder = Decoder()

    def lines() -> Iterator[tuple[float, Speeds]]:
        for time, data in chunks:
            for reading in decoder.feed(data):
                a, b, c, d = (speed for speed in reading.speeds if speed is not None)
                yield time, (a, b, c, d)

    waited = list(lines())
    assert not decoder.refused
    return waited
