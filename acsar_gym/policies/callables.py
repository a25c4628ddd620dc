"""Policies written in Python: "mine.py:act" is the function `act` of the file mine.py."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import AcsarError, PolicyError, suggestion
from acsar_gym.policies.base import FilePolicy, one_line
from acsar_gym.reading import bounded
from acsar_gym.tasks import Observation

MAX_BYTES = 10_000_000


def is_callable(policy: str) -> bool:
    """Return whether a policy argument names a Python file.

    Args:
        policy: such as "mine.py" or "mine.py:act".
    """
    return policy.endswith(".py") or policy.rpartition(":")[0].endswith(".py")


class CallablePolicy(FilePolicy):
    """A policy that is a function of a Python file, observation (n,) to action (2,).

    Loading it runs the code of the file.

    Args:
        policy: "FILE.py:FUNCTION".
        env_id: id of the env that it is for; by default the file's own global ENV_ID.

    Raises:
        PolicyError: there is no such file or function, its code raises an exception, no env is
            named, or (when called) the action isn't two finite numbers.
    """

    def __init__(self, policy: str, env_id: str = "") -> None:
        file, _, self._name = (
            policy.rpartition(":") if not policy.endswith(".py") else (policy, "", "")
        )
        self.path = Path(file)
        source = bounded.read(self.path, MAX_BYTES, PolicyError)
        self.sha256, self.function = hashlib.sha256(source).hexdigest(), self._name
        module = self._imported(source)
        self._act = self._found(module)
        self.env_id = env_id or str(getattr(module, "ENV_ID", ""))
        self.env_named = True  # the user runs this file's code, so its ENV_ID is trusted
        if not self.env_id:
            raise PolicyError(
                f"{self.path}: doesn't say which environment it is for: pass --env point_goal or "
                "another, or set ENV_ID in it"
            )

    def _imported(self, source: bytes) -> ModuleType:
        """Run the file's source as a module."""
        name = f"acsar_gym_policy_{self.path.stem}"
        spec = importlib.util.spec_from_file_location(name, self.path)
        if spec is None:
            raise PolicyError(f"{self.path}: not a Python file")
        module = importlib.util.module_from_spec(spec)
        folder = str(self.path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)  # the file may import modules of its own folder
        sys.modules[name] = module  # dataclasses and pickle look modules up there
        try:
            exec(compile(source, self.path, "exec"), module.__dict__)  # noqa: S102 - named by the user
        except AcsarError:
            raise
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a user's code raises
            raise self._failure("can't be run", error) from None
        return module

    def _found(self, module: ModuleType) -> Any:
        """Return the named function; the error names the functions that the file does have."""
        known = [n for n, value in vars(module).items() if callable(value) and n[:1] != "_"]
        act = getattr(module, self._name, None) if self._name else None
        if not callable(act):
            named = f"has no function {self._name!r}" if self._name else "name a function of it"
            hint = suggestion(self._name, known) if known else ""
            raise PolicyError(f"{self.path}: {named}, as in {self.path.name}:act{hint}")
        return act

    def _failure(self, what: str, error: BaseException) -> PolicyError:
        """Build the error for an exception in the user's code, with the line of the file."""
        frames = traceback.extract_tb(error.__traceback__)
        lines = [f.lineno for f in frames if f.filename == str(self.path)]
        line = getattr(error, "lineno", None) or (lines[-1] if lines else 0)
        return PolicyError(f"{self.path}, line {line}: {what}: {one_line(error)}")

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Call the function; returns its action, shape (2,).

        Raises:
            PolicyError: the function raises an exception, or gives anything but two finite
                numbers.
        """
        try:
            given = self._act(observation)
        except AcsarError:
            raise
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a user's code raises
            raise self._failure(f"{self._name} failed", error) from None
        try:
            action = np.asarray(given, np.float32)
        except Exception:  # noqa: BLE001 - torch has errors of its own for tensors with gradients
            action = np.full(0, np.nan, np.float32)
        if action.shape != (2,) or not np.isfinite(action).all():
            said = repr(given).replace("\n", " ")[:100]
            raise PolicyError(f"{self.path}: {self._name} gave {said}: must be two finite numbers")
        return action
