"""Envs that are closed when a test ends."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import env_tools
import gymnasium
import pytest
from env_tools import Make


@pytest.fixture
def make() -> Iterator[Make]:
    """As `env_tools.make`; closes what it has made."""
    envs: list[gymnasium.Env[Any, Any]] = []

    def make_env(env_id: str = env_tools.POINT_GOAL, link: Any = "planar", **options: Any) -> Any:
        envs.append(env_tools.make(env_id, link, **options))
        return envs[-1]

    yield make_env
    for env in envs:
        env.close()
