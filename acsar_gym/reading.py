"""Files, JSON and YAML of strangers within bounds; files that are written whole or not at all.

Whoever reads a file bounds its size, the parsers how many values it may have: an empty list of two
bytes takes 72 in memory. Only regular files are read. Each mistake is an error of one line.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import json
import math
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from types import FunctionType
from typing import IO, Any

import yaml

from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    shorten_text,
    show_value,
    suggest_name,
)

OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags for opening; non-blocking, as a pipe may replace the file after it was checked."""
STREAM_PATHS = ("/dev/std", "/dev/fd/", "/proc/")
"""Names of what the program has open already: the shell's "> FILE" must not be replaced."""
MAX_JSON_VALUES = 1_000_000  # by brackets and commas; they take up to 230 MB
MAX_YAML_EVENTS = 20_000  # beginnings and ends of lists and mappings, keys, values
MAX_YAML_DEPTH = 20  # deepest nesting of lists and mappings in YAML, which are made by recursion
COMMAND: ContextVar[str] = ContextVar("command", default="")
"""Name of the running command, such as "evaluate"."""
ORIGIN_BYTES = 4096  # where in a file its origin must be found [bytes from the beginning]
YAML_ERRORS = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)
"""Exceptions of the YAML library; malformed scalars raise the built-in ones."""


def read_file(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """Read a regular file.

    Args:
        path: the file.
        limit: largest accepted size [bytes].
        error: class of the exception.

    Raises:
        AcsarError: as `error`, if the file isn't regular, too large, or can't be read. The
            message begins with the path.
    """
    try:
        return read_content(path, limit, error)
    except error as problem:
        raise error(f"{shorten_text(str(path))}: {problem}") from problem


def read_content(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """Read as `read_file` does; error messages don't contain the path."""
    with _open_checked(path, limit, error) as file:
        data = file.read(limit + 1)  # the size may be unknown, as in /proc, or grow
        if len(data) > limit:
            raise _too_large(limit, error)
    return data


@contextlib.contextmanager
def open_file(path: Path, limit: int | None) -> Iterator[BufferedReader]:
    """Open a regular file, of `limit` bytes at most, to read it piece by piece; a context manager.

    Raises:
        ConfigError: as by `read_file`; also for errors inside the block.
    """
    try:
        with _open_checked(path, limit, ConfigError) as file:
            yield file
    except ConfigError as problem:
        raise ConfigError(f"{shorten_text(str(path))}: {problem}") from problem


@contextlib.contextmanager
def _open_checked(
    path: Path, limit: int | None, error: type[AcsarError]
) -> Iterator[BufferedReader]:
    """Open a regular file within the limit; raises `error`, also for OSErrors inside the block."""
    try:
        status = os.stat(path)  # noqa: PTH116 - before opening, too: that resets some boards
        for opened in (False, True):
            if not stat.S_ISREG(status.st_mode):
                raise error("isn't a regular file")
            if limit is not None and status.st_size > limit:
                raise _too_large(limit, error)
            if not opened:
                file = os.fdopen(os.open(path, OPEN_FLAGS), "rb")
                status = os.fstat(file.fileno())
        with file:
            yield file
    except FileNotFoundError as problem:
        raise error("there is no such file") from problem
    except (OSError, ValueError) as problem:
        raise error(f"can't be read: {explain_error(problem)}") from problem


def _too_large(limit: int, error: type[AcsarError]) -> AcsarError:
    size = f"{limit / 1e6:g} MB" if limit >= 100_000 else f"{limit:,} bytes"
    return error(f"is larger than {size}, the most that is read")


def write_atomically(path: Path, data: bytes, error: type[AcsarError] = ConfigError) -> None:
    """Write a file so that it is either whole, or what it was before; see `replace_file`.

    Raises:
        AcsarError: as `error`, if it can't be written, or is a pipe that nobody reads.
    """
    try:
        with replace_file(path) as new, open(new, "wb", opener=open_nonblocking) as file:
            file.write(data)
    except (OSError, ValueError) as problem:
        raise error(
            f"{shorten_text(str(path))}: can't be written: {explain_error(problem)}"
        ) from problem


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Replace a file atomically, as a context manager: the old one stays until the block ends.

    So a full disk, a signal or a power failure leaves the old file or the new one, never half of
    it. The new file keeps the old one's permissions and, where the system allows it, its owner.
    Links stay links to it. Devices and pipes can't be replaced: they are written in place.

    Args:
        path: the file.

    Yields:
        The path to write to: an empty file in the same folder, of the same kind by its suffix.

    Raises:
        OSError: it can't be replaced, as it is write-protected or its folder can't be written.
    """
    try:
        before = os.stat(path)  # noqa: PTH116 - follows links without resolving them
    except FileNotFoundError:
        before = None
    if before and (not stat.S_ISREG(before.st_mode) or str(path).startswith(STREAM_PATHS)):
        yield path
        return
    place = Path(os.path.realpath(path))
    if before:
        os.close(os.open(place, os.O_WRONLY))  # raises where it is write-protected
    new = place.with_name(f".{place.stem[:32]}-{secrets.token_hex(4)}{place.suffix}")
    os.close(os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        if before:
            with contextlib.suppress(PermissionError, AttributeError):  # Windows has no owners
                shutil.chown(new, before.st_uid, before.st_gid)
            new.chmod(stat.S_IMODE(before.st_mode))
        yield new
        with new.open("ab") as file:
            os.fsync(file.fileno())
        new.replace(place)
    finally:
        new.unlink(missing_ok=True)


def describe_origin() -> str:
    """Return the words by which the running command knows a file again that it wrote."""
    return f"written by acsar-gym {COMMAND.get()}"


def check_replaceable(path: Path, mark: str | None = None, *, force: bool = False) -> None:
    """Check that writing a file loses none of somebody else's.

    Replaced are empty files and those that the same command wrote; devices and pipes are written.

    Raises:
        ConfigError: there is another file, or another kind of file, of that name.
    """
    if force or not path.is_file() or str(path).startswith(STREAM_PATHS):
        return
    mark = describe_origin() if mark is None else mark
    try:
        with path.open("rb") as file:
            head = file.read(ORIGIN_BYTES)
    except OSError:
        head = b"unreadable"
    if head and not (mark and mark.encode() in head):
        fix = "name another file, or replace it with --force"
        if mark:
            fix = f"exists and wasn't written by 'acsar-gym {COMMAND.get()}': {fix}"
        else:
            fix = f"exists: {fix}"
        raise ConfigError(f"{shorten_text(str(path))}: {fix}")


def open_nonblocking(path: str, flags: int) -> int:
    """Open without blocking, for `open(opener=...)`; a pipe without a peer is an error."""
    blocking = getattr(os, "O_NONBLOCK", 0)
    file = os.open(path, flags | blocking, 0o666)
    if blocking:
        os.set_blocking(file, True)
    return file


def open_lines(path: Path) -> IO[str]:
    """Open a text file for writing line by line; ConfigError if that fails."""
    try:
        return open(path, "w", buffering=1, encoding="ascii", opener=open_nonblocking)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error


def write_line(file: IO[str], line: str) -> None:
    """Write a line; ConfigError if that fails, as on a full disk."""
    try:
        file.write(line)
    except OSError as error:
        with contextlib.suppress(OSError):
            file.close()
        raise ConfigError(f"{file.name}: can't be written: {error.strerror}") from error


def explain_error(problem: BaseException) -> str:
    """Return the message of an exception as one short line."""
    return getattr(problem, "strerror", None) or " ".join(str(problem).split())[:200]


@contextlib.contextmanager
def find_modules_here() -> Iterator[None]:
    """Let imports inside the block find modules in the current folder, as for a script there."""
    if "" in sys.path:
        yield
        return
    sys.path.append("")
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove("")


def import_object(what: str, name: str) -> Any:
    """The object of a module that is named "module:Class"; ConfigError where there is none."""
    module, _, attribute = name.partition(":")
    field, like = f"{what} = {show_value(name)}", "must be like 'module:Class'"
    if not all(part.isidentifier() for part in (*module.split("."), *attribute.split("."))):
        raise ConfigError(f"{field}: {like}")
    try:
        value: Any = importlib.import_module(module)
        for part in attribute.split("."):
            value = getattr(value, part)
    except AcsarError:
        raise
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{field}: {explain_error(error)}; {like}") from error
    except (Exception, SystemExit) as error:
        said = f"{type(error).__name__}: {explain_error(error)}"
        raise ConfigError(f"{field}: the module {module} can't be imported: {said}") from error
    return value


def object_name(kind: type | FunctionType) -> str | None:
    """The "module:name" that imports a class or function; None where none does: a local one."""
    value: Any = sys.modules.get(kind.__module__)
    for part in kind.__qualname__.split("."):
        value = getattr(value, part, None)
    importable = value is kind and kind.__module__ != "__main__"
    return f"{kind.__module__}:{kind.__qualname__}" if importable else None


def decode_text(data: bytes, error: type[AcsarError] = ConfigError) -> str:
    """Decode UTF-8; raises `error` if it isn't UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error("isn't UTF-8 text: save it as UTF-8") from problem


def _parse_finite(text: str) -> float:
    """Parse a float; ValueError for NaN, and for one that is too large, as 1e999 is."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is no number")
    return number


_JSON = json.JSONDecoder(parse_float=_parse_finite, parse_constant=_parse_finite)


def parse_json(
    text: str | bytes, error: type[AcsarError] = ConfigError, most: int = MAX_JSON_VALUES
) -> Any:
    """Parse JSON.

    Raises:
        AcsarError: as `error`, for invalid JSON, NaN, too long numbers, and too many values.
    """
    try:
        text = text if isinstance(text, str) else str(text, "utf-8")
        if sum(map(text.count, "[{,")) > most:
            raise error(f"has more than {most:,} values, the most that are read")
        return _JSON.decode(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"not valid JSON: {explain_error(problem)}") from problem


def parse_yaml(
    text: str, error: type[AcsarError] = ConfigError, most: int = MAX_YAML_EVENTS
) -> Any:
    """Parse a YAML document.

    Raises:
        AcsarError: as `error`, for invalid YAML, several documents, aliases, keys that aren't text,
            too long numbers or strings, too many values, and too deep nesting.
    """
    try:
        _check_events(text, error, most)
        return yaml.load(text, Loader=_Loader)  # noqa: S506 -- derived from the safe loader
    except YAML_ERRORS as problem:
        raise error(f"not valid YAML: {explain_error(problem)}") from problem


def parse_yaml_entry(
    text: str, names: Sequence[str], error: type[AcsarError] = ConfigError, *, hint: str
) -> tuple[str, Any]:
    """Parse YAML with aliases and merge keys; returns name and value of the first of these entries.

    Raises:
        AcsarError: as `error`, for no such entry, with `hint`, and as by `parse_yaml`.
    """
    try:
        _check_events(text, error, MAX_YAML_EVENTS, aliases=True)
        root = yaml.compose(text, Loader=_MergingLoader)
        if not isinstance(root, yaml.MappingNode):
            raise error("must be values by name")
        entries = {k.value: value for k, value in root.value if isinstance(k, yaml.ScalarNode)}
        name = next((name for name in names if name in entries), None)
        if name is None:
            near = shorten_text(suggest_name(names[0], entries), 120)
            missing = " and no ".join(map(show_value, names))
            raise error(f"has no {missing}{near.removesuffix('?')}: {hint}")
        if _count_values(entries[name], MAX_YAML_DEPTH, MAX_YAML_EVENTS) > MAX_YAML_EVENTS:
            raise error(f"{name}: is nested too deeply or has too many values, by its aliases")
        return name, _MergingLoader("").construct_document(entries[name])
    except YAML_ERRORS as problem:
        raise error(f"not valid YAML: {explain_error(problem)}") from problem


def _check_events(text: str, error: type[AcsarError], most: int, *, aliases: bool = False) -> None:
    """Check the bounds of a YAML document, without making anything of it."""
    depth = 0
    events: Iterator[Any] = yaml.parse(text, Loader=_Loader)
    for count, event in enumerate(events):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        where = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent) and not aliases:
            raise error(f"{where}: has an alias (*), which is refused: write the value out")
        if depth > MAX_YAML_DEPTH or count > most:
            raise error(f"{where}: is nested too deeply or has too many values")


def _count_values(node: yaml.Node, depth: int, most: int) -> int:
    """Count the nodes of a value with its aliases written out; more than `most` for too many."""
    if depth < 0:
        return most + 1
    count = 1
    parts = node.value if isinstance(node, yaml.CollectionNode) else ()
    for part in itertools.chain.from_iterable(
        pair if isinstance(pair, tuple) else (pair,) for pair in parts
    ):
        if count > most:
            break
        count += _count_values(part, depth - 1, most - count)
    return count


def format_yaml_line(data: Any) -> str:
    """Format as `format_yaml`, on one line, to stand anywhere in a document."""
    line = yaml.dump(
        [data], Dumper=_Dumper, default_flow_style=True, allow_unicode=True, width=math.inf
    )
    return line.strip()[1:-1]


def compose_yaml(text: str) -> yaml.Node | None:
    """Return the nodes of a YAML document that `parse_yaml` accepts, with their places in it."""
    return yaml.compose(text, Loader=yaml.SafeLoader)


def format_yaml(data: Any) -> str:
    """Format mappings, lists and scalars as YAML that `parse_yaml` reads back equal."""
    return yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True
    )


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, in C if available, that reads 1e-3 as a number as YAML 1.2 does."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse keys that aren't strings: only hashes of strings are randomized."""
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                merge = " (<< is refused: write the values out)" if key.value == "<<" else ""
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: a key must be text, in quotes if need be{merge}")


class _MergingLoader(_Loader):
    """The same, with merge keys: `<<: *defaults`."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Write the values of merge keys out; refuse other keys that aren't strings."""
        yaml.SafeLoader.flatten_mapping(self, node)
        super().flatten_mapping(node)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


class _Dumper(yaml.SafeDumper):
    """Quotes text that `_Loader` would read as a number; writes equal values out."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_str(self, data: str) -> yaml.ScalarNode:
        """Escape NEL (U+0085), a line end that the loader would read as a space."""
        style = '"' if "\x85" in data else None
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=style)


_Dumper.add_representer(str, _Dumper.represent_str)
