"""Where a robot's values come from: intervals that identification and calibration found."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterator, Mapping
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import Field, StringConstraints, TypeAdapter, ValidationError, model_validator
from pydantic.fields import FieldInfo

from acsar_gym.config.section import Name, PerWheel, Section
from acsar_gym.errors import ConfigError

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
WHEEL_LETTERS = ("a", "b", "c", "d")
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


def validate_measured(measured: Mapping[str, Measured], model: type[Section]) -> None:
    """Check names and ends of intervals: numbers of a robot, such as "motor.gain.a"; ConfigError.

    Args:
        measured: the intervals by dotted name.
        model: the section that has the fields; every end must be a value that its field can have.
    """
    known = _fields(model) if measured else {}
    for name, interval in measured.items():
        if name not in known:
            near = difflib.get_close_matches(name[:60], sorted(known), n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else "for example 'motor.gain.a'"
            raise ConfigError(f"measured: unknown field {name[:60]!r}; {hint}")
        for end in ("low", "high"):
            _check_end(f"measured.{name}.{end}", getattr(interval, end), _adapter(model, name))


def _check_end(path: str, value: float, adapter: TypeAdapter[Any]) -> None:
    """ConfigError where an end of an interval is out of its field's bounds."""
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        allowed = error.errors(include_url=False)[0]["msg"].removeprefix("Input should ")
        raise ConfigError(f"{path} = {value:g}: must {allowed}") from None


@functools.cache
def _adapter(model: type[Section], name: str) -> TypeAdapter[Any]:
    """The validator of an interval's ends; those of whole numbers aren't bounded."""
    field = _fields(model)[name]
    kind: Any = float if field.annotation is int else field.annotation
    bounds = [] if field.annotation is int else field.metadata
    return TypeAdapter(Annotated[kind, *bounds, Field()])


@functools.cache
def _fields(model: type[Section]) -> dict[str, FieldInfo]:
    """All numbers of a section and its sections, by dotted name."""
    return dict(_numbers(model))


def update_measured(
    known: Mapping[str, Measured], found: Mapping[str, Measured | None]
) -> dict[str, Measured]:
    """Return the intervals of a robot after new findings, for its field `measured`.

    Args:
        known: before.
        found: of each field with a new value; None where it has no interval. One for all wheels
            replaces those of single wheels, and one of a single wheel leaves the others theirs.
    """
    result = dict(known)
    for name in found:
        field, _, wheel = name.rpartition(".")
        if wheel in WHEEL_LETTERS and field in result:
            every = result.pop(field)
            result = {f"{field}.{other}": every for other in WHEEL_LETTERS} | result
        for old in (name, *(f"{name}.{other}" for other in WHEEL_LETTERS)):
            result.pop(old, None)
    return result | {name: interval for name, interval in found.items() if interval is not None}


def _numbers(model: type[Section], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Dotted names of all numbers of a section, and their fields."""
    for name, field in model.model_fields.items():
        kinds = _kinds(field.annotation)
        inner = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Section)]
        if inner:
            yield from _numbers(inner[0], f"{prefix}{name}.")
        elif float in kinds or int in kinds:
            yield f"{prefix}{name}", field
            if field.annotation == PerWheel:
                yield from ((f"{prefix}{name}.{wheel}", field) for wheel in WHEEL_LETTERS)


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """The types of a union, without the metadata of Annotated ones."""
    if get_origin(annotation) is Annotated:
        return _kinds(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return tuple(kind for part in get_args(annotation) for kind in _kinds(part))
    return (annotation,)
