"""Files, JSON, YAML and names of objects that users give.

Every reader takes a limit of size, and every mistake is an error of one line. A file is written
completely or not at all, and replaced only if the same command wrote it.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from types import FunctionType
from typing import Any

import yaml

from acsar_gym.errors import AcsarError, ConfigError, explain_error, format_error, show_value

STREAM_PATHS = ("/dev/std", "/dev/fd/", "/proc/")
"""Names of files that the program has open already. The shell's "> FILE" must not be replaced."""
MAX_YAML_DEPTH = 20
"""Deepest nesting of lists and mappings: the C library's recursion ends the process at 30,000."""
COMMAND: ContextVar[str] = ContextVar("command", default="")
"""Name of the running command, such as "evaluate"."""
ORIGIN_BYTES = 4096
"""A file that a command wrote names the command within this number of bytes."""


def read_file(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """Read a regular file.

    Args:
        path: The file.
        limit: Largest accepted size [bytes].
        error: Class of the exception.

    Raises:
        AcsarError: The file isn't regular, is too large, or can't be read. The
            message starts with the path.
    """
    try:
        return read_content(path, limit, error)
    except error as problem:
        raise error(f"{path}: {problem}") from problem


def read_content(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """Read a file as `read_file` does. The error messages don't contain the path."""
    with _open_regular(path, error) as file:
        data = file.read(limit + 1)

    if len(data) > limit:
        size = f"{limit / 1e6:g} MB" if limit >= 100_000 else f"{limit:,} bytes"
        raise error(f"is larger than {size}, the most that is read")
    return data


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[BufferedReader]:
    """Open a regular file to read it piece by piece.

    Raises:
        ConfigError: The file can't be read, see `read_file`, or reading fails inside the block.
    """
    try:
        with _open_regular(path, ConfigError) as file:
            yield file
    except ConfigError as problem:
        raise ConfigError(f"{path}: {problem}") from problem


@contextlib.contextmanager
def _open_regular(path: Path, error: type[AcsarError]) -> Iterator[BufferedReader]:
    try:
        # Check before opening: a pipe would block, and a serial port resets some boards.
        if path.exists() and not path.is_file():
            raise error("isn't a regular file")
        with path.open("rb") as file:
            yield file
    except FileNotFoundError as problem:
        raise error("there is no such file") from problem
    except (OSError, ValueError) as problem:
        raise error(f"can't be read: {explain_error(problem)}") from problem


def decode_text(data: bytes, error: type[AcsarError] = ConfigError) -> str:
    """Decode UTF-8. Raises `error` for anything else."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error("isn't UTF-8 text: save it as UTF-8") from problem


@contextlib.contextmanager
def name_errors(*names: object) -> Iterator[None]:
    """Put file and keys in front of the errors that are raised in this context."""
    try:
        yield
    except (ConfigError, TypeError, ValueError) as error:
        raise ConfigError(": ".join([*map(str, names), str(error)])) from error


def write_atomically(path: Path, data: bytes, error: type[AcsarError] = ConfigError) -> None:
    """Write a file as `replace_file` does.

    Raises:
        AcsarError: The file can't be written, or is a pipe that no process reads. Its class is
            `error`.
    """
    try:
        with replace_file(path) as new, open(new, "wb", opener=open_nonblocking) as file:
            file.write(data)
    except (OSError, ValueError) as problem:
        raise error(f"{path}: can't be written: {explain_error(problem)}") from problem


def open_nonblocking(path: str, flags: int) -> int:
    """Open a file, for `open`. A pipe that no process reads is an error: a robot can't wait."""
    nonblocking = getattr(os, "O_NONBLOCK", 0)  # Windows has no such pipes
    file = os.open(path, flags | nonblocking, 0o666)
    if nonblocking:
        os.set_blocking(file, True)
    return file


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Replace a file atomically: after a full disk or a signal, the old file is still there.

    The new file keeps the permissions and, if the system allows it, the owner of the old file.
    Symbolic links to it stay links. Devices and pipes are written in place.

    Args:
        path: The file.

    Yields:
        The path to write to: a new file in the same folder, with the same suffix.

    Raises:
        OSError: The file can't be replaced, because it or its folder is write-protected.
    """
    target = Path(os.path.realpath(path))
    old = target.stat() if target.exists() else None
    if str(path).startswith(STREAM_PATHS) or (old and not target.is_file()):
        yield path
        return
    # A write-protected file is not replaced, although its folder would allow it.
    if old:
        target.open("ab").close()  # raises if it is write-protected

    new = target.with_name(f".{target.stem[:32]}-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield new
        if old:
            with contextlib.suppress(PermissionError, AttributeError):  # Windows has no owners
                shutil.chown(new, old.st_uid, old.st_gid)
            shutil.copymode(target, new)
        # The content must be on the disk before the name points to it.
        with new.open("ab") as file:
            os.fsync(file.fileno())
        new.replace(target)
    finally:
        new.unlink(missing_ok=True)


def describe_origin() -> str:
    """Return the words by which the running command recognizes a file that it wrote."""
    return f"written by acsar-gym {COMMAND.get()}"


def check_replaceable(path: Path, mark: str | None = None) -> None:
    """Check that writing a file destroys nothing that the running command hasn't written.

    Args:
        path: The file. An empty file, a device and a pipe are written.
        mark: Words in a file that may be replaced, by default `describe_origin()`. If they are
            empty, no file is replaced.

    Raises:
        ConfigError: There is another file of this name.
    """
    if not path.is_file() or str(path).startswith(STREAM_PATHS):
        return
    # The mark is in the first bytes of everything that commands write.
    mark = describe_origin() if mark is None else mark
    try:
        with path.open("rb") as file:
            head = file.read(ORIGIN_BYTES)
    except OSError:
        head = b"unreadable"
    if not head or (mark and mark.encode() in head):
        return

    reason = f"exists and wasn't written by 'acsar-gym {COMMAND.get()}'" if mark else "exists"
    raise ConfigError(f"{path}: {reason}: name another file, or delete it")


def _parse_finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is no number")
    return number


def parse_json(text: str | bytes, error: type[AcsarError] = ConfigError) -> Any:
    """Parse JSON.

    Raises:
        AcsarError: The JSON is invalid, or a number is NaN or too large. Its class is `error`.
    """
    try:
        return json.loads(text, parse_float=_parse_finite, parse_constant=_parse_finite)
    except (ValueError, RecursionError) as problem:
        raise error(f"not valid JSON: {explain_error(problem)}") from problem


class YamlLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which reads 1e-3 as a number as YAML 1.2 does. Every key is text."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Write merge keys out, and refuse keys that aren't text."""
        super().flatten_mapping(node)
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: a key must be text, in quotes if need be")


YamlLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


class YamlDumper(yaml.SafeDumper):
    """The safe dumper, which quotes text that `YamlLoader` would read as a number."""

    yaml_implicit_resolvers = YamlLoader.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:
        """Write equal values out."""
        return True


def parse_yaml(text: str, error: type[AcsarError] = ConfigError) -> Any:
    """Parse a YAML document.

    Args:
        text: The document.
        error: Class of the exception.

    Raises:
        AcsarError: The YAML is invalid, several documents, or nested too deeply.
    """
    try:
        # Check the events before objects are made of them.
        depth = 0
        events: Iterator[Any] = yaml.parse(text, Loader=YamlLoader)
        for event in events:
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            line = event.start_mark.line + 1
            if depth > MAX_YAML_DEPTH:
                raise error(f"line {line}: is nested too deeply")
            if isinstance(event, yaml.AliasEvent):
                raise error(f"line {line}: has an alias (*), which is refused: write the value out")

        return yaml.load(text, Loader=YamlLoader)  # noqa: S506 -- derived from the safe loader
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError) as problem:
        raise error(f"not valid YAML: {explain_error(problem)}") from problem


def format_yaml(data: Any) -> str:
    """Format mappings, lists and scalars as YAML that `parse_yaml` reads back equal."""
    return yaml.dump(
        data, Dumper=YamlDumper, sort_keys=False, default_flow_style=None, allow_unicode=True
    )


@contextlib.contextmanager
def find_modules_here() -> Iterator[None]:
    """Let imports inside the block find modules in the current folder, as a script there does."""
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
    """Import the object that is named "module:Class".

    Args:
        what: What the object is, for messages.
        name: Its name.

    Raises:
        ConfigError: There is none, or its module can't be imported.
    """
    field = f"{what} = {show_value(name)}"
    must = "must be like 'module:Class'"
    # Only identifiers: importing anything else would fail with less clear errors.
    module, _, attribute = name.partition(":")
    if not all(word.isidentifier() for word in f"{module}.{attribute}".split(".")):
        raise ConfigError(f"{field}: {must}")

    try:
        value: Any = importlib.import_module(module)
        for word in attribute.split("."):
            value = getattr(value, word)
    except AcsarError:
        raise
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{field}: {explain_error(error)}; {must}") from error
    except (Exception, SystemExit) as error:
        reason = f"the module {module} can't be imported: {format_error(error)}"
        raise ConfigError(f"{field}: {reason}") from error
    return value


def object_name(kind: type | FunctionType) -> str | None:
    """Return the "module:name" that imports a class or function. None if it is local."""
    value: Any = sys.modules.get(kind.__module__)
    for word in kind.__qualname__.split("."):
        value = getattr(value, word, None)
    is_importable = value is kind and kind.__module__ != "__main__"
    return f"{kind.__module__}:{kind.__qualname__}" if is_importable else None
