"""Types of fields: numbers with unit and range, and names."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

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
