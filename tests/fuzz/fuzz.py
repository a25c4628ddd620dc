"""Coverage-guided fuzzing of everything that reads what others wrote: python fuzz.py TARGET.

Targets: decoder, config, world. Needs atheris (`make fuzz` installs it); what it finds is written
to a file and printed. Errors of the package's own are what is wanted; anything else is a find.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["acsar_gym"]):
    from acsar_gym.config import RobotConfig
    from acsar_gym.errors import AcsarError
    from acsar_gym.protocol import Decoder
    from acsar_gym.worlds import files

FOLDER = Path(tempfile.mkdtemp(prefix="acsar-fuzz-"))


def decoder(data: bytes) -> None:
    """Any bytes, in any chunks: the same readings, bounded memory."""
    provider = atheris.FuzzedDataProvider(data)
    cut = provider.ConsumeIntInRange(0, len(data))
    one, other = Decoder(), Decoder()
    whole = one.feed(data)
    parts = other.feed(data[:cut]) + other.feed(data[cut:])
    if whole != parts:
        raise AssertionError(f"chunks matter: {data!r} cut at {cut}")


def config(data: bytes) -> None:
    """A robot's file: valid, or one ConfigError."""
    suffix = ".yaml" if data[:1] < b"\x80" else ".urdf"
    read(data[1:], suffix, RobotConfig.load)


def world(data: bytes) -> None:
    """A world's file of any kind: valid, or one WorldError."""
    suffixes = (".json", ".yaml", ".world")
    read(data[1:], suffixes[(data[0] if data else 0) % len(suffixes)], files.load_world)


def read(data: bytes, suffix: str, load: Callable[[Path], object]) -> None:
    path = FOLDER / f"input{suffix}"
    path.write_bytes(data)
    with contextlib.suppress(AcsarError):
        load(path)


TARGETS = {"decoder": decoder, "config": config, "world": world}


if __name__ == "__main__":
    target = TARGETS[sys.argv.pop(1)]
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
