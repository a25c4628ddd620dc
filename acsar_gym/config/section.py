"""Sections of the configuration.

Frozen, validated, one exception for bad values; types of fields.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    TypeAdapter,
    ValidationError,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from acsar_gym.errors import ConfigError, show_value, suggest_name

MAX_PROBLEMS = 10
"""Most problems that one message lists."""


class Section(BaseModel):
    """A section of the config; unknown fields and bad values raise ConfigError."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    section: ClassVar[str] = ""
    """Name of the field of RobotConfig that holds this section."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_one_error(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Convert pydantic's ValidationError to ConfigError."""
        try:
            return handler(data)
        except ValidationError as error:
            raise ConfigError(_describe(cls, cls.section, error)) from None


def _describe(model: type[BaseModel], section: str, error: ValidationError) -> str:
    """Format the problems of a section as one message."""
    found = error.errors(include_url=False, include_context=False)
    parts = [_problem(model, section, item) for item in found[:MAX_PROBLEMS]]
    if len(found) > MAX_PROBLEMS:
        parts.append(f"and {len(found) - MAX_PROBLEMS:,} more")
    return "; ".join(parts)


def _problem(model: type[BaseModel], section: str, item: Any) -> str:
    """Format one problem: field, value and allowed range."""
    path = [str(part)[:40] for part in item["loc"]]
    field = ".".join([section, *path] if section else path)
    if item["type"] == "missing":
        return f"{field!r} is missing"
    if item["type"] == "extra_forbidden":
        near = suggest_name(str(item["loc"][-1])[:40], model.model_fields)
        return f"unknown field {field!r}{near}"
    allowed = item["msg"].removeprefix("Value error, ").removeprefix("Input should ")
    return f"{field} = {show_value(item['input'])}: {_must(allowed)}"


def _must(allowed: str) -> str:
    return f"must {allowed}" if allowed.startswith("be") else allowed


Length = Annotated[float, Field(gt=0.0, le=100.0)]
"""[m]"""
Offset = Annotated[float, Field(ge=-100.0, le=100.0)]
"""[m]"""
Speed = Annotated[float, Field(gt=0.0, le=1e3)]
"""[m/s] or [rad/s]"""
Rate = Annotated[float, Field(gt=0.0, le=1e4)]
"""[Hz]"""
Wait = Annotated[float, Field(gt=0.0, le=3600.0)]
"""[s], at most 1 h."""
Name = Annotated[str, Field(max_length=1000)]
Delay = Annotated[float, Field(ge=0.0, le=1.0)]
"""[s], at most 1 s."""
PerWheel = float | tuple[float, float, float, float]
"""A number for all wheels, or four in the order a, b, c, d."""


def value_of_wheel(value: PerWheel, wheel: int) -> float:
    """Return the number of one wheel, 0 to 3 for a to d."""
    return value[wheel] if isinstance(value, tuple) else value


def per_wheel(bounds: Any) -> WrapValidator:
    """Return a validator of `PerWheel` fields, whose numbers have bounds: a pydantic `Field`."""
    one: TypeAdapter[float] = TypeAdapter(Annotated[float, bounds], config={"allow_inf_nan": False})

    def checked(value: Any, _: Any) -> PerWheel:
        if not isinstance(value, list | tuple):
            return one.validate_python(value)
        if len(value) != 4:
            raise PydanticCustomError(
                "per_wheel", "must be a valid number, or four for the wheels a, b, c, d"
            )
        a, b, c, d = map(one.validate_python, value)
        return a, b, c, d

    return WrapValidator(checked)
