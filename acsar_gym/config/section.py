"""The base class of sections, which are frozen and validated, and the types of their fields."""

from __future__ import annotations

from collections.abc import Mapping
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
"""Most problems that an error message lists."""


class Section(BaseModel):
    """A section of the config. Unknown fields and bad values raise ConfigError."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    section: ClassVar[str] = ""
    """Name of the field of RobotConfig that holds this section."""
    hints: ClassVar[Mapping[str, str]] = {}
    """What to write instead of fields of other programs, by their names."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_one_error(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Convert pydantic's ValidationError to ConfigError."""
        try:
            return handler(data)
        except ValidationError as error:
            # Pydantic knows all problems of a section at once.
            problems = error.errors(include_url=False, include_context=False)
            lines = [cls._describe_problem(item) for item in problems[:MAX_PROBLEMS]]
            if len(problems) > MAX_PROBLEMS:
                lines.append(f"and {len(problems) - MAX_PROBLEMS:,} more")
            raise ConfigError("; ".join(lines)) from error

    @classmethod
    def _describe_problem(cls, item: Any) -> str:
        """Field, value and allowed range of an error of pydantic."""
        # Names come from users' files and may be very long.
        path = [str(name)[:40] for name in item["loc"]]
        field = ".".join([cls.section, *path] if cls.section else path)
        if item["type"] == "missing":
            return f"{field!r} is missing"
        # A similar name is the best hint, unless another program has a name for it.
        if item["type"] == "extra_forbidden":
            name = str(item["loc"][-1])
            hint = cls.hints.get(name)
            near = f"; {hint}" if hint else suggest_name(name[:40], cls.model_fields)
            return f"unknown field {field!r}{near}"
        allowed = item["msg"].removeprefix("Value error, ").removeprefix("Input should ")
        must = "must " if allowed.startswith("be") else ""
        return f"{field} = {show_value(item['input'])}: {must}{allowed}"


Factor = Annotated[float, Field(gt=0.0, le=100.0)]
Length = Factor  # [m]
Offset = Annotated[float, Field(ge=-100.0, le=100.0)]  # [m]
Speed = Annotated[float, Field(gt=0.0, le=1e3)]  # [m/s] or [rad/s]
Rate = Annotated[float, Field(gt=0.0, le=1e4)]  # [Hz]
Wait = Annotated[float, Field(gt=0.0, le=3600.0)]  # [s], at most 1 h
Name = Annotated[str, Field(max_length=1000)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Delay = Share  # [s], at most 1 s
PerWheel = float | tuple[float, float, float, float]
"""A number for all wheels, or four in the order a, b, c, d."""


def value_of_wheel(value: PerWheel, wheel: int) -> float:
    """Return the number of a wheel, 0 to 3 for a to d."""
    return value[wheel] if isinstance(value, tuple) else value


def per_wheel(bounds: Any) -> WrapValidator:
    """Return a validator of `PerWheel` fields.

    Args:
        bounds: Limits of each number, a pydantic `Field`.
    """
    adapter: TypeAdapter[float] = TypeAdapter(
        Annotated[float, bounds], config={"allow_inf_nan": False}
    )

    def checked(value: Any, _: Any) -> PerWheel:
        # The adapter is called for each number, so that errors name the number.
        if not isinstance(value, list | tuple):
            return adapter.validate_python(value)
        if len(value) != 4:
            raise PydanticCustomError(
                "per_wheel", "must be a valid number, or four for the wheels a, b, c, d"
            )
        a, b, c, d = map(adapter.validate_python, value)
        return a, b, c, d

    return WrapValidator(checked)
