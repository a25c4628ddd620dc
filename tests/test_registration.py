"""Importing the package is light, and Gymnasium knows its ids in every order of imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from serial_tools import TIMEOUT

import acsar_gym
from acsar_gym import registration

KNOWN = "assert gymnasium.spec('acsar_gym/PointGoal-v0').max_episode_steps == 200"
ORDERS = {
    "ours first": f"import acsar_gym; import gymnasium; {KNOWN}",
    "theirs first": f"import gymnasium; import acsar_gym; {KNOWN}",
    "by the id": (
        "import gymnasium; "
        "gymnasium.make('acsar_gym:acsar_gym/PointGoal-v0', link='planar').close()"
    ),
    "a part of ours first": f"import acsar_gym.envs; import gymnasium; {KNOWN}",
    "looked for before": (
        "import acsar_gym, importlib.util; importlib.util.find_spec('gymnasium'); "
        f"import gymnasium; {KNOWN}"
    ),
    "a part of theirs": f"import acsar_gym; import gymnasium.spaces; import gymnasium; {KNOWN}",
    "imported anew": (
        "import sys, acsar_gym; "
        "del sys.modules['acsar_gym'], sys.modules['acsar_gym.registration']; "
        f"import acsar_gym; import gymnasium; {KNOWN}; assert not any('acsar' in type(f).__module__"
        " for f in sys.meta_path)"
    ),
    "in threads": (
        "import threading, importlib as i; names = ['acsar_gym', 'gymnasium'] * 4; "
        "threads = [threading.Thread(target=i.import_module, args=(n,)) for n in names]; "
        "[t.start() for t in threads]; [t.join() for t in threads]; "
        f"import gymnasium; {KNOWN}"
    ),
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
    run(ORDERS[order])


@pytest.mark.parametrize("code", ["import acsar_gym", ESTOP], ids=["import", "estop"])
def test_the_standard_library_is_all_that_is_imported(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", str(tmp_path / "missing"))
    assert run(LOADED.format(code=code)) == "acsar_gym"


def test_names_are_there_as_if_they_had_been_imported() -> None:
    assert {*acsar_gym.__all__, "__version__"} <= set(dir(acsar_gym))
    assert all(getattr(acsar_gym, name) is not None for name in acsar_gym.__all__)
    assert (
        acsar_gym.safety.rules.Reason.LIMITS.name == "LIMITS"
    )  # a module that nobody has imported here
    with pytest.raises(AttributeError, match="no attribute 'saftey'"):
        _ = acsar_gym.saftey
    assert not hasattr(acsar_gym, "__path_of_nothing__")


def test_a_second_registration_changes_nothing(recwarn: pytest.WarningsRecorder) -> None:
    registration.register_all()
    registration.when_gymnasium_is_imported()
    assert not recwarn.list
