"""Importing the package registers its ids, and imports nothing slow. Imports have no circles."""

from __future__ import annotations

import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest

import acsar_gym
from acsar_gym.testing import TIMEOUT

KNOWN = "assert gymnasium.spec('acsar_gym/PointGoal-v0').max_episode_steps == 200"
ORDERS = {
    "ours first": f"import acsar_gym; import gymnasium; {KNOWN}",
    "theirs first": f"import gymnasium; import acsar_gym; {KNOWN}",
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
def test_import_registers_the_ids_in_any_order(order: str) -> None:
    run(f"{ORDERS[order]}; import acsar_gym; acsar_gym.registration.register_all()")


@pytest.mark.parametrize("code", ["import acsar_gym", ESTOP], ids=["import", "estop"])
def test_import_loads_nothing_slow(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", str(tmp_path / "missing"))
    loaded = set(run(LOADED.format(code=code)).split())
    assert {"acsar_gym", "gymnasium", "numpy"} <= loaded
    assert not loaded & {"numba", "pydantic", "rich", "scipy", "serial", "torch", "tyro"}


def test_import_has_all_names() -> None:
    assert {*acsar_gym.__all__, "__version__"} <= set(dir(acsar_gym))
    assert all(getattr(acsar_gym, name) is not None for name in acsar_gym.__all__)
    assert (
        acsar_gym.safety.rules.Reason.LIMITS.name == "LIMITS"
    )  # a module that nobody has imported here
    with pytest.raises(AttributeError, match="no attribute 'saftey'"):
        _ = acsar_gym.saftey
    assert not hasattr(acsar_gym, "__path_of_nothing__")


def test_imports_have_no_circles() -> None:
    graph = grimp.build_graph("acsar_gym", exclude_type_checking_imports=True)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    assert len(imports) > 100
    TopologicalSorter(imports).prepare()  # which raises CycleError
