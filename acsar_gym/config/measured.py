"""Where a robot's values come from: intervals that identification and calibration found."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterator, Mapping
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import Field, StringConstraints, TypeAdapter, ValidationError, model_validator

from acsar_gym.config.section import Name, PerWheel, Section
from acsar_gym.errors import ConfigError

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
WHEEL_LETTERS = ("a", "b", "c", "d")
LogHash = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{16}$")]
LogHashes = Annotated[tuple[LogHash, ...], Field(max_length=1_000)]


class Measured(Section):
    """The 95 % interval of one measured value, and what it was measured from."""

    section = "measured"
    low: Number
    """Lower end, in the unit of the field."""
    high: Number
    """Upper end."""
    method: Name
    """How it was measured, such as "identify" or "calibrate straight"."""
    logs: LogHashes = ()
    """First 16 hex digits of the SHA-256 of each log."""

    @model_validator(mode="after")
    def _is_an_interval(self) -> Measured:
        """Check the order of the ends."""
        if self.low > self.high:
            raise ConfigError(f"measured: low = {self.low:g}: must be at most high = {self.high:g}")
        return self


def validate_measured(measured: Mapping[str, Measured], model: type[Section]) -> None:
    """Raise ConfigError for intervals of no number of the model, or with bad ends."""
    known = _find_numbers(model) if measured else {}
    for name, interval in measured.items():
        if name not in known:
            near = difflib.get_close_matches(name[:60], sorted(known), n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else "for example 'motor.gain.a'"
            raise ConfigError(f"measured: unknown field {name[:60]!r}; {hint}")
        for end in ("low", "high"):
            value = getattr(interval, end)
            try:
                known[name].validate_python(value)
            except ValidationError as error:
                allowed = error.errors(include_url=False)[0]["msg"].removeprefix("Input should ")
                raise ConfigError(f"measured.{name}.{end} = {value:g}: must {allowed}") from error


@functools.cache
def _find_numbers(model: type[Section], prefix: str = "") -> dict[str, TypeAdapter[Any]]:
    """Validators of all numbers of a section and its sections, by dotted name."""
    found: dict[str, TypeAdapter[Any]] = {}
    for name, field in model.model_fields.items():
        kinds = list(_unpack_union(field.annotation))
        inner = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Section)]
        if inner:
            found |= _find_numbers(inner[0], f"{prefix}{name}.")
        elif float in kinds or int in kinds:
            whole = field.annotation is int  # the interval of a whole number has any ends
            bounds = () if whole else field.metadata
            kind: Any = float if whole else field.annotation
            adapter: TypeAdapter[Any] = TypeAdapter(Annotated[kind, *bounds, Field()])
            found[f"{prefix}{name}"] = adapter
            if field.annotation == PerWheel:
                found |= {f"{prefix}{name}.{wheel}": adapter for wheel in WHEEL_LETTERS}
    return found


def _unpack_union(annotation: Any) -> Iterator[Any]:
    """The types of a union, without the metadata of Annotated ones."""
    if get_origin(annotation) is Annotated:
        yield from _unpack_union(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, UnionType):
        for part in get_args(annotation):
            yield from _unpack_union(part)
    else:
        yield annotation


def update_measured(
    known: Mapping[str, Measured], found: Mapping[str, Measured | None]
) -> dict[str, Measured]:
    """Return the intervals of a robot after new findings, for its field `measured`.

    An interval for all wheels replaces those of single wheels; one of a single wheel leaves the
    others theirs; None ends one.
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
