"""Base class of all sections: frozen, validated, one exception for bad values."""

from __future__ import annotations

from typing import Any, ClassVar, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)

from acsar_gym.errors import ConfigError, shown, suggestion

MOST_TOLD = 10
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
    parts = [_problem(model, section, item) for item in found[:MOST_TOLD]]
    if len(found) > MOST_TOLD:
        parts.append(f"and {len(found) - MOST_TOLD:,} more")
    return "; ".join(parts)


def _problem(model: type[BaseModel], section: str, item: Any) -> str:
    """Format one problem: field, value and allowed range."""
    path = [str(part)[:40] for part in item["loc"]]
    field = ".".join([section, *path] if section else path)
    if item["type"] == "extra_forbidden":
        near = suggestion(str(item["loc"][-1])[:40], model.model_fields)
        return f"unknown field {field!r}{near}"
    allowed = item["msg"].removeprefix("Value error, ").removeprefix("Input should ")
    return f"{field} = {shown(item['input'])}: {_must(allowed)}"


def _must(allowed: str) -> str:
    return f"must {allowed}" if allowed.startswith("be") else allowed
