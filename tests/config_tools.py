"""Errors of configs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError


def refusal(model: type[Any], values: Mapping[str, Any]) -> str:
    """The message of the one ConfigError that these values raise."""
    with pytest.raises(ConfigError) as caught:
        model(**values)
    message = str(caught.value)
    assert "\n" not in message
    return message


def config_of(**values: Any) -> RobotConfig:
    return RobotConfig(**values)
