"""JSON and YAML that others wrote, within bounds, so that no text takes long or much memory.

No aliases or merges, little nesting, no numbers of a thousand digits. Whatever breaks a bound is
one error of one line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any

import yaml

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.reading.bounded import reason

MOST_DIGITS = 100
"""Characters of a number."""
MOST_CHARACTERS = 10_000
"""Of one text in a YAML."""
MOST_DEPTH = 20
"""Lists and mappings within each other."""
MOST_EVENTS = 300_000
"""Values, and beginnings and ends of lists and mappings, in a YAML: a world of 20,000 segments
whose path has 20,000 points has 200,000."""
YAML_ERRORS = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)
"""What the YAML library lets out for malformed scalars, besides its own errors."""
TEXT = "tag:yaml.org,2002:str"
MERGE = "tag:yaml.org,2002:merge"


def decoded(data: bytes, error: type[AcsarError] = ConfigError) -> str:
    """The text of a file's content. Raises `error` where it isn't UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error("isn't UTF-8 text: save it as UTF-8") from None


def from_json(text: str | bytes, error: type[AcsarError] = ConfigError) -> Any:
    """What a JSON text says. Raises `error` for text that isn't JSON, NaN, or a number too long."""
    try:
        return _JSON.decode(text if isinstance(text, str) else str(text, "ascii"))
    except (ValueError, RecursionError) as problem:
        raise error(f"not valid JSON: {reason(problem)}") from None


def from_yaml(text: str, error: type[AcsarError] = ConfigError) -> Any:
    """What a YAML text of one document says.

    Raises `error` for text that isn't YAML, and for aliases, merges, numbers that are too long,
    too many values or too deep a nesting.
    """
    try:
        _check(yaml.parse(text, Loader=_Loader), error)
        return yaml.load(text, Loader=_Loader)  # noqa: S506 -- a safe one
    except YAML_ERRORS as problem:
        raise error(f"not valid YAML: {reason(problem)}") from None


def _whole(text: str) -> int:
    _check_length(text)
    return int(text)


def _real(text: str) -> float:
    _check_length(text)
    return float(text)


def _no_number(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _check_length(text: str) -> None:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a number of {len(text):,} characters")


_JSON = json.JSONDecoder(parse_int=_whole, parse_float=_real, parse_constant=_no_number)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Safe, fast where it can be, and 1e-3 is a number as it is in JSON and YAML 1.2."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Called for every mapping instead of merging what `<<` names.

        Keys are texts, whose hashes nobody can foresee; numbers could be chosen to collide.
        """
        for key, _ in node.value:
            if key.tag != TEXT:
                merge = "merges (<<) are refused: write the values out"
                found = merge if key.tag == MERGE else "a key must be text, in quotes if need be"
                raise ValueError(f"line {key.start_mark.line + 1}: {found}")

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """Bounded, since numbers to the base of 60 (1:30:00) take a time that grows squared."""
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


def _check(events: Iterable[yaml.Event], error: type[AcsarError]) -> None:
    """Refuse what would grow or nest without end, before anything is built of it."""
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
