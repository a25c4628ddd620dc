"""Policies in Python: a function, a class or an object."""

from __future__ import annotations

import hashlib
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from acsar_gym import reading
from acsar_gym.errors import (
    AcsarError,
    PolicyError,
    escape_unprintable,
    format_error,
    suggest_name,
)
from acsar_gym.tasks import Observation
from acsar_gym.tools.policies.policy import Actions, FilePolicy, PolicyContext

MAX_SOURCE_BYTES = 10_000_000
_FILE = re.compile(r"(?P<file>.*\.py)(:(?P<name>[^:]*))?")
_MODULE_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")


def is_callable(policy: Any) -> bool:
    """Return whether a policy argument means Python code: a file, a module, or an object.

    Args:
        policy: Such as "mine.py", "mine.py:act", "mine.module:Planner", or anything but a text.
    """
    if not isinstance(policy, str) or _FILE.fullmatch(policy):
        return True
    return _MODULE_NAME.fullmatch(policy) is not None and not Path(policy).exists()


class CallablePolicy(FilePolicy):
    """A policy in Python: a function, a class or an object, observation (n,) to action (2,).

    An object, also one of the class, may have a state: `bind(setting)` is called once for each env,
    with its `PolicyContext`, and `reset()` at the start of each episode, right after the env's
    reset. Loading one from a file or module runs its code.

    Args:
        policy: "FILE.py:NAME" or "module:NAME" of a function or class, or an object. A class is
            called without arguments, a `FilePolicy` such as a baseline with `env_id`.
        env_id: Id of the env that it is for. Default: the global ENV_ID of file or module, or the
            `env_id` of the object.

    Raises:
        PolicyError: There is no such file or name, its code raises an exception, no env is named,
            or (when called) the action isn't two finite numbers.
        ConfigError: There is no such module, or no such name in it.

    Example:
        from acsar_gym.tools.policies import CallablePolicy

        policy = CallablePolicy(lambda observation: (0.5, 0.0), "acsar_gym/PointGoal-v0")
    """

    env_named = True
    """The user runs this code, so its ENV_ID is trusted."""

    def __init__(self, policy: Any, env_id: str = "") -> None:
        module, code = self._find(policy)
        if not callable(code):
            problem = f"has no function {self._name!r}" if self._name else "name a function of it"
            functions = [name for name, value in vars(module).items() if callable(value)]
            hint = suggest_name(self._name, functions)
            raise PolicyError(f"{self.path}: {problem}, as in {self.path.name}:act{hint}")

        # What the user names takes precedence over what the code names.
        self.said_id = str(getattr(module, "ENV_ID", "") or getattr(code, "env_id", ""))
        """The id that the code itself names. Empty if it names none."""
        self.env_id = env_id or self.said_id
        if not self.env_id:
            raise PolicyError(
                f"{self.path}: names no environment: pass --env point_goal or another, or set "
                "ENV_ID in it"
            )

        # A baseline needs to know its env to be made.
        self._act = code
        if isinstance(code, type):
            arguments = (self.env_id,) if issubclass(code, FilePolicy) else ()
            self._act = self._call("can't be made", code, *arguments)
            if not callable(self._act):
                raise PolicyError(f"{self.path}: {self._name} has no method __call__")

    def _find(self, policy: Any) -> tuple[ModuleType | None, Any]:
        """Return module and code of "FILE.py:NAME" or "module:NAME", or an object as it is."""
        self._source = ""
        if not isinstance(policy, str):
            self.instance = policy
            self._name = getattr(policy, "__name__", type(policy).__name__)
            self.path = Path(self._name)
            return None, policy
        if match := _FILE.fullmatch(policy):
            self.path = Path(match["file"])
            self.function = self._name = match["name"] or ""
            module = self._run_file(match["file"])
            return module, getattr(module, self._name, None)

        # A module in the current folder is found as well.
        place, _, self._name = policy.rpartition(":")
        self.path = Path(policy)
        with reading.find_modules_here():
            code = reading.import_object("policy", policy)
        module = sys.modules[place]
        self._source = str(getattr(module, "__file__", None) or "")
        if self._source:
            self.sha256 = hashlib.sha256(Path(self._source).read_bytes()).hexdigest()
        return module, code

    def _run_file(self, path: str) -> ModuleType:
        """Run a file as a module, with the modules of its folder."""
        self._source = path
        source = reading.read_file(self.path, MAX_SOURCE_BYTES, PolicyError)
        self.sha256 = hashlib.sha256(source).hexdigest()
        folder = str(self.path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)
        # The name is unlikely to be that of a module which the file imports.
        module = ModuleType(f"acsar_gym_policy_{self.path.stem}")
        module.__file__ = str(self.path.absolute())  # code finds its own files by it
        sys.modules[module.__name__] = module  # dataclasses and pickle look for modules there

        def run() -> None:
            exec(compile(source, path, "exec"), vars(module))  # noqa: S102 - named by the user

        self._call("can't be run", run)
        return module

    def bind(self, setting: PolicyContext) -> None:
        """Call `bind` of the object, if it has this method. PolicyError if that fails."""
        if (bind := getattr(self._act, "bind", None)) is not None:
            self._call("bind failed", bind, setting)

    def reset(self) -> None:
        """Call `reset` of the object, if it has this method. PolicyError if that fails."""
        if (reset := getattr(self._act, "reset", None)) is not None:
            self._call("reset failed", reset)

    def _call(self, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call the user's code. PolicyError with the line of the file that raised an error."""
        try:
            return function(*arguments)
        except AcsarError:
            raise
        except (Exception, SystemExit) as error:
            # The last line of the user's own file, not of a library that it calls.
            frames = traceback.extract_tb(error.__traceback__)
            lines = [frame.lineno for frame in frames if frame.filename == self._source]
            lines += [error.lineno] if isinstance(error, SyntaxError) else []
            place = f"{self.path}, line {lines[-1]}" if lines else f"{self.path}"
            raise PolicyError(f"{place}: {what}: {format_error(error)}") from error

    def __call__(self, observation: Observation) -> Actions:
        """Call the function, and return its action, shape (2,).

        Raises:
            PolicyError: The function raises an exception, or doesn't return two finite numbers.
        """
        returned = self._call(f"{self._name} failed", self._act, observation)
        try:
            action = np.asarray(returned, np.float32)
        except Exception:  # noqa: BLE001 - torch has errors of its own for tensors with gradients
            action = np.full(0, np.nan, np.float32)
        if action.shape != (2,) or not np.isfinite(action).all():
            text = escape_unprintable(repr(returned), 100)
            raise PolicyError(f"{self.path}: {self._name} gave {text}: must be two finite numbers")
        return action
