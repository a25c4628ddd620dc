"""The registered ids in small worlds, and envs that are closed when a test ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import pytest

import acsar_gym  # noqa: F401 - registers the ids

IDS: dict[str, dict[str, Any]] = {
    "acsar_gym/PointGoal-v0": {},
    "acsar_gym/ObstacleGoal-v1": {"worlds": "clutter:5"},
    "acsar_gym/Barn-v1": {"worlds": "barn:5"},
    "acsar_gym/Crowd-v0": {"worlds": "crowd:5"},
    "acsar_gym/DynaBarn-v0": {"worlds": "dynabarn:5"},
    "acsar_gym/PathFollow-v0": {"worlds": "waypoint_path:5"},
}


@pytest.fixture(params=IDS)
def env_id(request: pytest.FixtureRequest) -> Any:
    """Each registered id."""
    return request.param


@pytest.fixture(params=["bullet", "planar"])
def link(request: pytest.FixtureRequest) -> Any:
    """Each of the fast simulated links."""
    return request.param


@pytest.fixture
def make() -> Iterator[Callable[..., Any]]:
    """`make(env_id, link, ...)` makes an env in small worlds."""
    envs: list[Any] = []

    def make_env(
        env_id: str = "acsar_gym/PointGoal-v0", link: Any = "planar", **options: Any
    ) -> Any:
        envs.append(gymnasium.make(env_id, link=link, **{**IDS[env_id], **options}))
        return envs[-1]

    yield make_env
    for env in envs:
        env.close()
