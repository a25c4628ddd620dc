"""Where a robot's values come from: intervals that identification and calibration found."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated, Any, get_args

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
    for name, interval in measured.items():
        adapter = _find_number(model, name)
        if adapter is None:
            raise ConfigError(f"measured: unknown field {name[:60]!r}: must be like 'motor.gain.a'")
        for end in ("low", "high"):
            value = getattr(interval, end)
            try:
                adapter.validate_python(value)
            except ValidationError as error:
                allowed = error.errors(include_url=False)[0]["msg"].removeprefix("Input should ")
                raise ConfigError(f"measured.{name}.{end} = {value:g}: must {allowed}") from error


@functools.lru_cache(maxsize=256)
def _find_number(model: type[Section], name: str) -> TypeAdapter[Any] | None:
    """The validator of a field by its dotted name; None where there is none."""
    part, _, inner = name.partition(".")
    field = model.model_fields.get(part)
    if field is None:
        return None
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, Section):
            return _find_number(kind, inner)
    if inner and not (field.annotation == PerWheel and inner in WHEEL_LETTERS):
        return None
    is_whole = field.annotation is int  # whose interval has any ends
    kind: Any = float if is_whole else Annotated[field.annotation, *field.metadata, Field()]
    return TypeAdapter(kind)


def update_measured(
    measured: Mapping[str, Measured], findings: Mapping[str, Measured | None]
) -> dict[str, Measured]:
    """Return the intervals of a robot after new findings, for its field `measured`.

    An interval for all wheels replaces those of single wheels; one of a single wheel leaves the
    others theirs; None ends one.
    """
    result = dict(measured)
    for name in findings:
        field, _, wheel = name.rpartition(".")
        if wheel in WHEEL_LETTERS and field in result:
            every = result.pop(field)
            result = {f"{field}.{other}": every for other in WHEEL_LETTERS} | result
        for old in (name, *(f"{name}.{other}" for other in WHEEL_LETTERS)):
            result.pop(old, None)
    return result | {name: interval for name, interval in findings.items() if interval is not None}
