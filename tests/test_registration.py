"""Importing the package registers its ids, and imports nothing slow."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

import acsar_gym
from acsar_gym.envs.ids import make_vec
from acsar_gym.errors import ConfigError
from acsar_gym.tasks import ObstacleGoal
from acsar_gym.testing import TIMEOUT

KNOWN = "assert gymnasium.spec('acsar_gym/PointGoal-v0').max_episode_steps == 200"
ORDERS = {
    "ours first": f"import acsar_gym; import gymnasium; {KNOWN}",
    "theirs first": f"import gymnasium; import acsar_gym; {KNOWN}",
    "by the id": (
        "import gymnasium; "
        "gymnasium.make('acsar_gym:acsar_gym/PointGoal-v0', link='planar').close()"
    ),
    "a part of ours first": f"import acsar_gym.envs; import gymnasium; {KNOWN}",
}
LOADED = """
import contextlib, sys
before = set(sys.modules)
{code}
names = {{name.split(".")[0] for name in set(sys.modules) - before}}
print(*sorted(names - set(sys.stdlib_module_names)))
"""
ESTOP = """
sys.argv = ["acsar-gym", "estop"]
from acsar_gym.__main__ import main
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(None):
    main()
"""


def run(code: str) -> str:
    """What a fresh interpreter says, for which every warning is an error."""
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("order", ORDERS)
def test_gymnasium_knows_the_ids(order: str) -> None:
    run(f"{ORDERS[order]}; import acsar_gym; acsar_gym.registration.register_all()")


@pytest.mark.parametrize("code", ["import acsar_gym", ESTOP], ids=["import", "estop"])
def test_nothing_slow_is_imported(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", str(tmp_path / "missing"))
    loaded = set(run(LOADED.format(code=code)).split())
    assert {"acsar_gym", "gymnasium", "numpy"} <= loaded
    assert not loaded & {"numba", "pydantic", "rich", "scipy", "serial", "torch", "tyro"}


def test_names_are_there_as_if_they_had_been_imported() -> None:
    assert {*acsar_gym.__all__, "__version__"} <= set(dir(acsar_gym))
    assert all(getattr(acsar_gym, name) is not None for name in acsar_gym.__all__)
    assert (
        acsar_gym.safety.rules.Reason.LIMITS.name == "LIMITS"
    )  # a module that nobody has imported here
    with pytest.raises(AttributeError, match="no attribute 'saftey'"):
        _ = acsar_gym.saftey
    assert not hasattr(acsar_gym, "__path_of_nothing__")


@pytest.fixture
def registered() -> Iterator[str]:
    """An id whose defaults only a single env, or only a batch, knows."""
    options: dict[str, Any] = {
        "lidar": "simulated",
        "on_fault": "raise",
        "threads": 1,
        "autoreset_mode": "Disabled",
    }
    acsar_gym.register("mine/Modes-v0", task=ObstacleGoal, worlds="clutter:0-1", **options)
    yield "mine/Modes-v0"
    del gymnasium.registry["mine/Modes-v0"]


def test_a_mode_ignores_registered_defaults_of_the_other(registered: str) -> None:
    one: Any = gymnasium.make(registered, link="planar").unwrapped
    assert one._options.on_fault == "raise"
    batch: Any = gymnasium.make_vec(registered, 2, vectorization_mode="vector_entry_point")
    assert batch.autoreset_mode is AutoresetMode.DISABLED
    again: Any = gymnasium.make(EnvSpec.from_json(one.spec.to_json())).unwrapped
    assert again._options.on_fault == "raise"
    given: Any = gymnasium.make(registered, link="planar", on_fault="truncate").unwrapped
    assert given._options.on_fault == "truncate"
    with pytest.raises(ConfigError, match="unknown option 'on_fault'"):
        make_vec(registered, 2, on_fault="raise")
    with pytest.raises(ConfigError, match="unknown option 'threads'"):
        gymnasium.make(registered, link="planar", threads=1)
