"""Where a robot's values come from: intervals that identification and calibration found."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import Field, StringConstraints, model_validator

from acsar_gym.config.section import Section
from acsar_gym.config.units import Name, PerWheel
from acsar_gym.errors import ConfigError

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
LogHash = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{16}$")]


class Measured(Section):
    """The 95 % interval of one measured value, and what it was measured from."""

    section = "measured"
    low: Number
    """Lower end, in the unit of the field."""
    high: Number
    """Upper end."""
    method: Name
    """How it was measured, such as "identify" or "calibrate straight"."""
    logs: Annotated[tuple[LogHash, ...], Field(max_length=1_000)] = ()
    """First 16 hex digits of the SHA-256 of each log."""

    @model_validator(mode="after")
    def _is_an_interval(self) -> Measured:
        """Check the order of the ends."""
        if self.low > self.high:
            raise ConfigError(f"measured: low = {self.low:g}: must be at most high = {self.high:g}")
        return self


def check_names(names: list[str], model: type[Section]) -> None:
    """Check that names are numbers of a robot, such as "motor.gain.a"; ConfigError if not."""
    known = set(_numbers(model))
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name[:60], sorted(known), n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else "for example 'motor.gain.a'"
            raise ConfigError(f"measured: unknown field {name[:60]!r}; {hint}")


def _numbers(model: type[Section], prefix: str = "") -> Iterator[str]:
    """Dotted names of all numbers of a section."""
    for name, field in model.model_fields.items():
        kinds = _kinds(field.annotation)
        inner = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Section)]
        if inner:
            yield from _numbers(inner[0], f"{prefix}{name}.")
        elif float in kinds or int in kinds:
            yield f"{prefix}{name}"
            if field.annotation == PerWheel:
                yield from (f"{prefix}{name}.{wheel}" for wheel in "abcd")


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """The types of a union, without the metadata of Annotated ones."""
    if get_origin(annotation) is Annotated:
        return _kinds(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return tuple(kind for part in get_args(annotation) for kind in _kinds(part))
    return (annotation,)
