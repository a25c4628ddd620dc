"""Which letter of the wire moves and which one reports each wheel, and with which sign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, ModelWrapValidatorHandler, model_validator

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError

LETTERS = "abcd"
Letter = Literal["a", "b", "c", "d"]
Sign = Literal[1, -1]
Speeds = tuple[float, float, float, float]
Heard = tuple[float | None, float | None, float | None, float | None]


class WheelConfig(Section):
    """One wheel's motor and encoder on the wire."""

    section = "wheels"
    motor: Letter
    """Letter that commands it."""
    motor_sign: Sign = 1
    """-1 where a positive command turns it backward."""
    encoder: Letter
    """Letter that reports its speed."""
    sign: Sign = 1
    """-1 where its encoder reports a forward turn as negative."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_one_error(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Leave errors to WheelsConfig, which knows the wheel's name."""
        return handler(data)


def _wheel(letter: Letter) -> BeforeValidator:
    """Return a validator that sets missing letters of a wheel to its own."""
    own = {"motor": letter, "encoder": letter}
    return BeforeValidator(lambda given: {**own, **given} if isinstance(given, dict) else given)


@dataclass(frozen=True, slots=True)
class Letters:
    """Which letter belongs to each wheel, for one direction of the wire.

    Attributes:
        places: index of each wheel's letter, in the order of the wheels.
        signs: 1.0 or -1.0 for each wheel.
    """

    places: tuple[int, int, int, int]
    signs: Speeds

    def to_wire(self, speeds: Sequence[float]) -> Speeds:
        """Convert speeds of the wheels to those of the letters a, b, c, d [rad/s]."""
        wire = [0.0, 0.0, 0.0, 0.0]
        for place, sign, speed in zip(self.places, self.signs, speeds, strict=True):
            wire[place] = sign * speed + 0.0  # no negative zero
        return wire[0], wire[1], wire[2], wire[3]

    def to_wheels(self, wire: Heard) -> Heard:
        """Convert speeds of the letters to those of the wheels [rad/s]; None where one misses."""
        a, b, c, d = (
            None if (speed := wire[place]) is None else sign * speed + 0.0
            for place, sign in zip(self.places, self.signs, strict=True)
        )
        return a, b, c, d


class WheelsConfig(Section):
    """The wiring: letters and signs of each wheel's motor and encoder."""

    section = "wheels"
    a: Annotated[WheelConfig, _wheel("a")] = WheelConfig(motor="a", encoder="a")
    """The front right wheel."""
    b: Annotated[WheelConfig, _wheel("b")] = WheelConfig(motor="b", encoder="b")
    """The front left wheel."""
    c: Annotated[WheelConfig, _wheel("c")] = WheelConfig(motor="c", encoder="c")
    """The rear left wheel."""
    d: Annotated[WheelConfig, _wheel("d")] = WheelConfig(motor="d", encoder="d")
    """The rear right wheel."""

    @model_validator(mode="after")
    def _letters_are_used_once(self) -> Self:
        """Check that no letter belongs to two wheels."""
        for part in ("motor", "encoder"):
            used = Counter(getattr(wheel, part) for wheel in self.each)
            twice = sorted(letter for letter, count in used.items() if count > 1)
            if twice:
                raise ConfigError(
                    f"wheels: {part} {twice[0]} belongs to {used[twice[0]]} wheels: each letter "
                    "must be used once"
                )
        return self

    @property
    def each(self) -> tuple[WheelConfig, WheelConfig, WheelConfig, WheelConfig]:
        """The wheels in the order a, b, c, d."""
        return self.a, self.b, self.c, self.d

    @property
    def motors(self) -> Letters | None:
        """Letters of the commands; None where every wheel has its own, forward."""
        return _letters([(wheel.motor, wheel.motor_sign) for wheel in self.each])

    @property
    def encoders(self) -> Letters | None:
        """Letters of the feedback; None where every wheel has its own, forward."""
        return _letters([(wheel.encoder, wheel.sign) for wheel in self.each])


def _letters(named: Sequence[tuple[str, int]]) -> Letters | None:
    """Return the mapping of four wheels; None for the identity."""
    if [letter for letter, sign in named if sign == 1] == list(LETTERS):
        return None
    a, b, c, d = (LETTERS.index(letter) for letter, _ in named)
    sa, sb, sc, sd = (float(sign) for _, sign in named)
    return Letters((a, b, c, d), (sa, sb, sc, sd))
