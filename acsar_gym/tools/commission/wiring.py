"""Finds which letters of the wire belong to each wheel, from how encoders answer to commands."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from acsar_gym.config import WheelConfig, WheelsConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.protocol import MOTORS
from acsar_gym.tools.sysid.board import HIGHEST_RATIO, LOWEST_RATIO, Lines

MOVING_SHARE = 0.4
"""A wheel with more than this share of the fastest wheel's speed turns."""
FAINT_SHARE = 0.025
"""A letter with less than this share of the commanded speed reports nothing. A usual wheel in m/s
has 0.05 of it."""
OTHER_SIDE = {"a": "b", "b": "a", "c": "d", "d": "c"}
"""Each wheel's letter, and that of the wheel on the other side."""


class SeenWheel(NamedTuple):
    """A wheel that turns when a letter is commanded forward."""

    wheel: str
    """Letter of the wheel."""
    way: int
    """1 if it turns forward, -1 if it turns backward."""


class WheelAnswer(NamedTuple):
    """How encoders answer when one letter is commanded forward."""

    encoders: str
    """Letters that report a turn, the fastest first. Empty if there are none."""
    ratio: float
    """Measured by commanded speed of the fastest encoder, with sign."""
    has_stopped: bool
    """Whether the wheel stopped although the command went on. The ratio is that before."""

    @classmethod
    def of(cls, lines: Lines, speed: float) -> WheelAnswer:
        """Return the answer to a speed that was commanded [rad/s]."""
        # A wheel may have stopped by itself, so that its fastest line counts.
        newest = lines.newest.mean(axis=0)
        fastest = lines.speeds[np.abs(lines.speeds).max(axis=1).argmax()]
        stands = np.abs(newest).max() < FAINT_SHARE * speed
        has_stopped = bool(stands and np.abs(fastest).max() > MOVING_SHARE * speed)
        ratios = (fastest if has_stopped else newest) / speed
        sizes = np.abs(ratios)

        # Other encoders that turn with the fastest are crosstalk, or share a wire.
        threshold = max(FAINT_SHARE, MOVING_SHARE * sizes.max())
        ranked = np.argsort(-sizes)
        encoders = "".join(MOTORS[index] for index in ranked if sizes[index] > threshold)
        return cls(encoders, float(ratios[ranked[0]]), has_stopped)

    @property
    def encoder(self) -> str:
        """Letter of the fastest encoder. Empty if none turned."""
        return self.encoders[:1]

    @property
    def is_right(self) -> bool:
        """Whether a wheel turned as fast as commanded, forward or backward."""
        return LOWEST_RATIO <= abs(self.ratio) <= HIGHEST_RATIO and not self.has_stopped


def parse_seen(answers: Sequence[str]) -> dict[str, SeenWheel]:
    """Read which wheel was seen to turn for each of the letters a, b, c, d.

    Args:
        answers: Letters of the wheels, with an n behind those that turned backward, or none.

    Returns:
        The wheels by letter, without the letters for which none turned.

    Raises:
        ConfigError: These can't have been seen.
    """
    # tyro takes any number of words, and those of the device as well.
    if len(answers) != len(MOTORS):
        raise ConfigError(
            f"--saw {' '.join(answers)}: must be four, the wheels that turned for a, b, c and d, "
            "such as b a d c; DEVICE stands before the options"
        )

    wheels: dict[str, SeenWheel] = {}
    for letter, answer in zip(MOTORS, answers, strict=True):
        match = re.fullmatch(r"([abcd])([pn]?)|none|0", answer.strip().lower())
        if match is None:
            raise ConfigError(
                f"{show_value(answer)}: write the wheel that turned (a front right, b front left, "
                "c rear left, d rear right), an n behind it if it turned backward, or none"
            )
        wheel, way = match.groups()
        if wheel in {turned.wheel for turned in wheels.values()}:
            raise ConfigError(f"{' '.join(answers)}: one wheel turned for two letters: look again")
        if wheel:
            wheels[letter] = SeenWheel(wheel, -1 if way == "n" else 1)
    return wheels


def wheels_of_file(file: WheelsConfig) -> dict[str, SeenWheel]:
    """Return which wheel each letter turns according to a robot's file."""
    return {
        wheel.motor: SeenWheel(letter, wheel.motor_sign)
        for letter, wheel in zip(MOTORS, file.each, strict=True)
    }


def wire_wheel(letter: str, turned: SeenWheel, answer: WheelAnswer) -> WheelConfig:
    """Return the wiring of the wheel that a letter turns, and that an encoder answers to."""
    # An encoder that counts backward while its wheel turns forward is reversed.
    sign = turned.way if answer.ratio > 0.0 else -turned.way
    return WheelConfig(motor=letter, motor_sign=turned.way, encoder=answer.encoder, sign=sign)


def infer_wiring(
    answers: Mapping[str, WheelAnswer], turned: Mapping[str, SeenWheel]
) -> WheelsConfig | None:
    """Infer the wiring from how encoders answer to each letter, and from which wheel it turns.

    Returns:
        The wiring. None unless each letter turns a wheel, and another encoder answers to each.
    """
    # A wiring needs four different encoders, else two wheels share one.
    encoders = {answer.encoder for answer in answers.values()} - {""}
    if len(turned) < len(MOTORS) or len(encoders) < len(MOTORS):
        return None
    wheels = {
        turned[letter].wheel: wire_wheel(letter, turned[letter], answer)
        for letter, answer in answers.items()
    }
    return WheelsConfig(**wheels)


def describe_sides(wiring: WheelsConfig) -> str:
    """Report motors or encoders whose left and right are swapped. Empty if there are none."""
    # The usual mistake: both plugs of an axle on the wrong side.
    swapped = [
        f"{device}s"
        for device in ("motor", "encoder")
        if all(getattr(getattr(wiring, a), device) == b for a, b in OTHER_SIDE.items())
    ]
    return f"left and right {' and '.join(swapped)} are swapped" if swapped else ""
