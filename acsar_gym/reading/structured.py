"""Parses the JSON and YAML of strangers in bounded time and memory; each mistake is one line.

Whoever reads a file bounds its size, the parsers how many values it may have: an empty list of two
bytes takes 72 in memory.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

import yaml

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.reading.bounded import reason

MOST_VALUES = 1_000_000
"""Most values in JSON, counted by the brackets and commas; they take up to 230 MB."""
MOST_EVENTS = 20_000
"""Most parser events in YAML: beginning or end of a list or mapping, key, value."""
MOST_CHARACTERS = 10_000
"""Longest string or number in YAML [characters]; numbers in base 60 take quadratic time."""
MOST_DEPTH = 20
"""Deepest nesting of lists and mappings in YAML."""
YAML_ERRORS = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)
"""Exceptions of the YAML library; malformed scalars raise the built-in ones."""


def decoded(data: bytes, error: type[AcsarError] = ConfigError) -> str:
    """Decode UTF-8; raises `error` if it isn't UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error("isn't UTF-8 text: save it as UTF-8") from None


def from_json(
    text: str | bytes, error: type[AcsarError] = ConfigError, most: int = MOST_VALUES
) -> Any:
    """Parse JSON.

    Args:
        text: the JSON.
        error: class of the exception.
        most: values that it may have.

    Raises:
        AcsarError: as `error`, for invalid JSON, NaN, too long numbers, and too many values.
    """
    try:
        text = text if isinstance(text, str) else str(text, "utf-8")
        if sum(map(text.count, "[{,")) > most:
            raise error(f"has more than {most:,} values, the most that are read")
        return _JSON.decode(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"not valid JSON: {reason(problem)}") from None


def from_yaml(text: str, error: type[AcsarError] = ConfigError, most: int = MOST_EVENTS) -> Any:
    """Parse a YAML document.

    Args:
        text: the YAML.
        error: class of the exception.
        most: parser events that it may have.

    Raises:
        AcsarError: as `error`, for invalid YAML, several documents, aliases, keys that aren't text,
            too long numbers or strings, too many values, and too deep nesting.
    """
    depth = 0
    try:
        events: Iterator[Any] = yaml.parse(text, Loader=_Loader)
        for count, event in enumerate(events):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            where = f"line {event.start_mark.line + 1}"
            if isinstance(event, yaml.AliasEvent):
                raise error(f"{where}: has an alias (*), which is refused: write the value out")
            if depth > MOST_DEPTH or count > most:
                raise error(f"{where}: is nested too deeply or has too many values")
            if isinstance(event, yaml.ScalarEvent) and len(event.value) > MOST_CHARACTERS:
                raise error(
                    f"{where}: a text of {len(event.value):,} characters, which is too long"
                )
        return yaml.load(text, Loader=_Loader)  # noqa: S506 -- derived from the safe loader
    except YAML_ERRORS as problem:
        raise error(f"not valid YAML: {reason(problem)}") from None


def to_yaml(data: Any) -> str:
    """Format mappings, lists and scalars as YAML that `from_yaml` reads back equal."""
    return yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True
    )


def _finite(text: str) -> float:
    """Parse a float; ValueError for NaN, and for one that is too large, as 1e999 is."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is no number")
    return number


_JSON = json.JSONDecoder(parse_float=_finite, parse_constant=_finite)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, in C if available, that reads 1e-3 as a number as YAML 1.2 does."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse keys that aren't strings; called for every mapping.

        Hashes of strings are randomized; numeric keys could be chosen to collide.
        """
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                merge = " (<< is refused: write the values out)" if key.value == "<<" else ""
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: a key must be text, in quotes if need be{merge}")


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
