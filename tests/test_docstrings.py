"""The public surface: what users import says what it takes, returns and raises.

The public surface is the names in `__all__` of the modules in `ROOMS`, and what docs/reference
shows, with the public methods of the classes. Sections are Google's; an override has those of the
method that it overrides, too.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest
from pydantic import BaseModel

from acsar_gym import errors

ROOMS = (
    "acsar_gym",
    "acsar_gym.tools.benchmark",
    "acsar_gym.physics.body",
    "acsar_gym.config",
    "acsar_gym.physics",
    "acsar_gym.envs",
    "acsar_gym.errors",
    "acsar_gym.kinematics",
    "acsar_gym.links",
    "acsar_gym.odometry",
    "acsar_gym.tools.policies",
    "acsar_gym.protocol",
    "acsar_gym.recording",
    "acsar_gym.registration",
    "acsar_gym.tools.jobs",
    "acsar_gym.sensors",
    "acsar_gym.tasks",
    "acsar_gym.worlds",
)
HEAVY = ("acsar_gym.tools.policies.rllib", "acsar_gym.tools.policies.sb3")
REFERENCE = Path(__file__).resolve().parents[1] / "docs" / "reference"
WORDS = "Args|Attributes|Raises|Returns|Warns|Yields"
NOTHING = {None, "None", "NoReturn", inspect.Signature.empty}


def shown() -> Iterator[tuple[str, Any]]:
    """What docs/reference shows beside, but for modules that import torch or ray."""
    text = "".join(page.read_text(encoding="utf-8") for page in sorted(REFERENCE.glob("*.md")))
    for name in re.findall(r"^::: (acsar_gym\S+)$", text, re.MULTILINE):
        home, _, own = name.rpartition(".")
        if home not in ROOMS + HEAVY and name not in ROOMS:
            yield name, getattr(importlib.import_module(home), own)


def exported() -> Iterator[tuple[str, Any]]:
    """Full names and values of what users import."""
    for room in ROOMS:
        module = importlib.import_module(room)
        for name in getattr(module, "__all__", None) or classes_in(module):
            value = getattr(module, name)
            yield f"{room}.{name}", getattr(value, "py_func", value)


def classes_in(module: ModuleType) -> list[str]:
    """The names of a module's own classes."""
    members = inspect.getmembers(module, inspect.isclass)
    return [name for name, kind in members if kind.__module__ == module.__name__]


def ours(kind: type) -> list[type]:
    """A class and those of its bases that are this package's."""
    return [base for base in kind.__mro__ if base.__module__.startswith("acsar_gym")]


def function_of(value: object) -> FunctionType | None:
    """The function of a method or property."""
    value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
    return value if isinstance(value, FunctionType) else None


def text_of(owner: object) -> str:
    """An object's own docstring, with its indentation removed."""
    own = vars(owner).get("__doc__") if isinstance(owner, type) else owner.__doc__
    return inspect.cleandoc(own or "")


def section(doc: str, word: str) -> str:
    """The text of a docstring's sections of one kind; empty where there is none."""
    found = re.findall(rf"^(?:{word}):\n(.*?)(?=^(?:{WORDS}):\n|\Z)", doc, re.M | re.S)
    return "".join(found)


def entries(doc: str, word: str) -> set[str]:
    """The names that a section has a line for; one line may be for several."""
    lines = re.findall(r"^ {4}(\S[^:\n]*):", section(doc, word), re.M)
    return {name.strip(" *`") for line in lines for name in line.split(",")}


def raised(function: FunctionType) -> set[str]:
    """The errors of this package that a function raises itself."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    names = {
        ast.unparse(node.exc.func if isinstance(node.exc, ast.Call) else node.exc).split(".")[-1]
        for node in ast.walk(tree)
        if isinstance(node, ast.Raise) and node.exc is not None
    }
    return {name for name in names if isinstance(getattr(errors, name, None), type)}


def gaps(name: str, function: FunctionType, doc: str, *, is_property: bool) -> Iterator[str]:
    """What the docstring of a function doesn't say."""
    signature = inspect.signature(function)
    asked = set(signature.parameters) - {"self", "cls"}
    said = entries(doc, "Args")
    yield from (f"{name}: Args: {one}" for one in sorted(asked - said) if one[0] != "_")
    yield from (f"{name}: no such argument: {one}" for one in sorted(said - asked))
    told = doc.startswith(("Return", "Yield", "Whether")) or section(doc, "Returns|Yields")
    if signature.return_annotation not in NOTHING and not (told or is_property):
        yield f"{name}: Returns: {signature.return_annotation}"
    known = entries(doc, "Raises")
    for error in sorted(raised(function)):
        if not known & {kind.__name__ for kind in getattr(errors, error).__mro__}:
            yield f"{name}: Raises: {error}"


def gaps_of_methods(name: str, kind: type) -> Iterator[str]:
    """What the docstrings of a class's public methods and properties don't say."""
    for base in ours(kind):
        for own, value in vars(base).items():
            function = function_of(value)
            if function is None or own.startswith("_"):
                continue
            docs = [text_of(vars(one)[own]) for one in ours(base) if own in vars(one)]
            doc = "\n".join([*docs, ""])
            yield from gaps(f"{name}.{own}", function, doc, is_property=isinstance(value, property))


def fields_of(kind: type) -> dict[str, bool]:
    """The fields of a data class or config, and whether a docstring stands below each."""
    found: dict[str, bool] = {}
    for base in ours(kind):
        tree = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(tree, ast.ClassDef)
        for node, below in zip(tree.body, [*tree.body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
                found.setdefault(node.target.id, text)
    names = [one.name for one in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
    names += list(getattr(kind, "model_fields", {}))
    return {name: found.get(name, False) for name in names if not name.startswith("_")}


def gaps_of_class(name: str, kind: type) -> Iterator[str]:
    """What a class doesn't say about its constructor and fields."""
    doc = "\n".join(text_of(base) for base in ours(kind))
    if dataclasses.is_dataclass(kind) or issubclass(kind, BaseModel):
        said = entries(doc, "Args|Attributes")
        said |= set(re.findall(r"`(\w+)`", doc))
        missing = (one for one, text in fields_of(kind).items() if not (text or one in said))
        yield from (f"{name}: field {one}" for one in missing)
        return
    if getattr(kind, "_is_protocol", False):
        return
    make = next((vars(base)["__init__"] for base in ours(kind) if "__init__" in vars(base)), None)
    if isinstance(make, FunctionType):
        makers = (vars(base)["__init__"] for base in ours(kind) if "__init__" in vars(base))
        own = "\n".join([doc, *map(text_of, makers), ""])
        yield from (gap for gap in gaps(name, make, own, is_property=False) if "no such" not in gap)


def told(name: str, value: Any) -> Iterator[str]:
    """All that the docstrings of an exported name don't say."""
    if isinstance(value, FunctionType):
        yield from gaps(name, value, text_of(value) + "\n", is_property=False)
    elif isinstance(value, type) and ours(value):
        yield from gaps_of_class(name, value)
        yield from gaps_of_methods(name, value)


def test_what_users_import_says_what_it_takes_returns_and_raises() -> None:
    names = dict(exported()) | dict(shown())
    assert len(names) > 100
    assert [gap for name, value in names.items() for gap in told(name, value)] == []


COMPLETE = """Return a, doubled.

Args:
    a: length [m].

Raises:
    ConfigError: it is negative.
"""


@pytest.mark.parametrize(
    ("doc", "found"),
    [
        (COMPLETE, []),
        (COMPLETE.replace("a: l", "b: l"), ["f: Args: a", "f: no such argument: b"]),
        (COMPLETE.replace("Return a,", "It is"), ["f: Returns: float"]),
        (COMPLETE.replace("ConfigError", "LinkError"), ["f: Raises: WorldError"]),
    ],
)
def test_gaps_are_found(doc: str, found: list[str]) -> None:
    function = function_of(doubled)
    assert isinstance(function, FunctionType)
    assert list(gaps("f", function, doc, is_property=False)) == found


def doubled(a: float) -> float:
    """What the docstrings above are about."""
    if a < 0.0:
        raise errors.WorldError("negative")
    return 2.0 * a
