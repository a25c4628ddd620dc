"""Parses untrusted JSON and YAML in bounded time and memory.

Aliases, merges, deep nesting and very long numbers are rejected. Every violation is reported as one
error with a message of one line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from typing import Any

import yaml

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.reading.bounded import reason

MOST_DIGITS = 100
"""Longest number [characters]."""
MOST_CHARACTERS = 10_000
"""Longest string in a YAML file [characters]."""
MOST_DEPTH = 20
"""Deepest nesting of lists and mappings."""
MOST_EVENTS = 300_000
"""Most parser events in a YAML file; a world with 20,000 segments and a path of 20,000 points has
200,000."""
YAML_ERRORS = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)
"""Exceptions of the YAML library; malformed scalars raise the built-in ones."""
TEXT = "tag:yaml.org,2002:str"
MERGE = "tag:yaml.org,2002:merge"


def decoded(data: bytes, error: type[AcsarError] = ConfigError) -> str:
    """Decode UTF-8; raises `error` if it isn't UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error("isn't UTF-8 text: save it as UTF-8") from None


def from_json(text: str | bytes, error: type[AcsarError] = ConfigError) -> Any:
    """Parse JSON.

    Args:
        text: the JSON.
        error: class of the exception.

    Raises:
        AcsarError: as `error`, for invalid JSON, NaN, and too long numbers.
    """
    try:
        return _JSON.decode(text if isinstance(text, str) else str(text, "ascii"))
    except (ValueError, RecursionError) as problem:
        raise error(f"not valid JSON: {reason(problem)}") from None


def from_yaml(text: str, error: type[AcsarError] = ConfigError) -> Any:
    """Parse a YAML document.

    Args:
        text: the YAML.
        error: class of the exception.

    Raises:
        AcsarError: as `error`, for invalid YAML, several documents, aliases, merges, too long
            numbers or strings, too many values, and too deep nesting.
    """
    try:
        _check(yaml.parse(text, Loader=_Loader), error)
        return yaml.load(text, Loader=_Loader)  # noqa: S506 -- derived from the safe loader
    except YAML_ERRORS as problem:
        raise error(f"not valid YAML: {reason(problem)}") from None


def to_yaml(data: Any) -> str:
    """Format mappings, lists and scalars as YAML that `from_yaml` reads back equal."""
    return yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True
    )


def _whole(text: str) -> int:
    """Parse an integer of bounded length."""
    _check_length(text)
    return int(text)


def _real(text: str) -> float:
    """Parse a float of bounded length."""
    _check_length(text)
    return float(text)


def _finite(text: str) -> float:
    """Parse a float of bounded length that isn't too large for one, as 1e999 is."""
    number = _real(text)
    if math.isinf(number):
        raise ValueError(f"{text} is no number")
    return number


def _no_number(constant: str) -> float:
    """Reject NaN and infinity."""
    raise ValueError(f"{constant} is no number")


def _check_length(text: str) -> None:
    """Reject too long numbers."""
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a number of {len(text):,} characters")


_JSON = json.JSONDecoder(parse_int=_whole, parse_float=_finite, parse_constant=_no_number)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A safe YAML loader, in C if available, that reads 1e-3 as a number as YAML 1.2 does."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Reject merges (`<<`) and keys that aren't strings; called for every mapping.

        Hashes of strings are randomized; numeric keys could be chosen to collide.
        """
        for key, _ in node.value:
            if key.tag != TEXT:
                merge = "merges (<<) are refused: write the values out"
                found = merge if key.tag == MERGE else "a key must be text, in quotes if need be"
                raise ValueError(f"line {key.start_mark.line + 1}: {found}")

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """Parse a number of bounded length; base-60 numbers (1:30:00) take quadratic time."""
        _check_length(node.value)
        whole = node.tag == "tag:yaml.org,2002:int"
        make = self.construct_yaml_int if whole else self.construct_yaml_float
        number: int | float = make(node)
        return number


for _kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.construct_number)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


class _Dumper(yaml.SafeDumper):
    """Quotes text that `_Loader` would read as a number."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:
        """Write equal values out: aliases are refused."""
        return True


def _check(events: Iterable[yaml.Event], error: type[AcsarError]) -> None:
    """Reject aliases, deep nesting and too many values before anything is constructed."""
    depth = 0
    for count, event in enumerate(events):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            raise error("has an alias (*), which is refused: write the value out")
        if depth > MOST_DEPTH or count > MOST_EVENTS:
            raise error("is nested too deeply or has too many values")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MOST_CHARACTERS:
            raise error(f"has a text of {len(event.value):,} characters, which is too long")
