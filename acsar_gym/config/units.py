"""Types of fields: numbers with unit and range, and names."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, TypeAdapter, WrapValidator
from pydantic_core import PydanticCustomError

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


def of_wheel(value: PerWheel, wheel: int) -> float:
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
