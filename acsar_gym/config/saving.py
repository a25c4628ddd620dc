"""Write robots as YAML: new files, or the values that differ in a user's file."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.resolver import VersionedResolver
from ruamel.yaml.util import load_yaml_guess_indent

from acsar_gym import reading
from acsar_gym.config import files
from acsar_gym.config.section import Section
from acsar_gym.config.sections import GEOMETRY_FIELDS
from acsar_gym.errors import ConfigError, explain_error, show_value

ROBOT_FILE_HEAD = (
    "# A robot for acsar_gym: its geometry, and what differs from the defaults. SI units.\n"
)
LINE_WIDTH = 10_000
"""Longer lines are wrapped: more characters than any line of a robot's file has."""
_HEAD = re.compile(r"(?:[ \t]*(?:#.*)?\n)*---[ \t]*(?:#.*)?\n")
"""Comments before "---", which ruamel.yaml drops."""


class _TextResolver(VersionedResolver):
    """Leaves scalars as they are written, since ruamel.yaml rounds numbers such as 1.5e-5."""

    versioned_resolver: ClassVar[Any] = {"": [("tag:yaml.org,2002:null", re.compile("$"))]}


def check_target(path: str | Path, kind: type[Section], *, force: bool = False) -> Path:
    """Return the path of a robot's file that may be written.

    Args:
        path: The file.
        kind: Class of the robot.
        force: Also accept a file that exists and isn't a robot's.

    Raises:
        ConfigError: The file has another suffix, or exists and isn't a robot's.
    """
    if not isinstance(path, str | Path) or Path(path).suffix not in files.YAML_SUFFIXES:
        name = str(path) if isinstance(path, Path) else path
        raise ConfigError(f"path = {show_value(name)}: a robot is written to .yaml or .yml")
    if not force:
        _read_present(Path(path), kind)
    return Path(path)


def save_robot(
    robot: Section,
    path: str | Path,
    remarks: Mapping[str, str],
    outdated: Sequence[str] = (),
    *,
    force: bool = False,
) -> None:
    """Write a robot's file, or change what differs in it. See `RobotConfig.save`."""
    path = check_target(path, type(robot), force=force)
    try:
        text, old = _read_present(path, type(robot))
    except ConfigError:  # a file to replace, since `check_target` accepted it
        text, old = _make_default(type(robot))

    # Lines end as they did. In between, "\n" is the only end.
    has_windows_lines = "\r\n" in text
    text = text.replace("\r\n", "\n")
    # Remarks that are written again below take their place.
    for remark in outdated:
        text = text.replace(_comment(remark), "")
    # Only what differs is changed, so that the rest of the file stays as it was written.
    text = _change_text(text, find_differences(robot, old))
    for name, remark in remarks.items():
        if _comment(remark) not in text:
            text = f"\n{text}".replace(f"\n{name}:", f"\n{_comment(remark)}{name}:")[1:]
    if has_windows_lines:
        text = text.replace("\n", "\r\n")
    reading.write_atomically(path, text.encode())


def _make_default(kind: type[Section]) -> tuple[str, Section]:
    """Return text and robot of a new file with the geometry."""
    robot = kind()
    lines = [f"{name}: {getattr(robot, name)}\n" for name in GEOMETRY_FIELDS]
    return ROBOT_FILE_HEAD + "".join(lines), robot


def _comment(remark: str) -> str:
    return "".join(f"# {line}\n" for line in remark.splitlines())


def _read_present(path: Path, kind: type[Section]) -> tuple[str, Section]:
    """Return text and robot of a file that can be changed, or of a new file."""
    if not path.is_file():
        return _make_default(kind)
    try:
        text = files.read_text(path)
        robot = kind.model_validate(files.read_own_fields(text, kind.model_fields))
        # A file that the editor cannot read must not be found out after a drive.
        _change_text(text, {})
    except ConfigError as error:
        raise ConfigError(
            f"{path}: is there, and isn't a robot's file, which would be changed in place "
            f"({error}): give another name"
        ) from error
    return text, robot


def find_differences(section: Section, usual: Section) -> dict[str, Any]:
    """Return the fields of a section that differ from those of another, as plain YAML values."""
    plain = section.model_dump(mode="json")
    differing: dict[str, Any] = {}
    for name, default in usual:
        value = getattr(section, name)
        if value != default:
            is_nested = isinstance(value, Section)
            differing[name] = (
                find_differences(value, default or type(value)()) if is_nested else plain[name]
            )
    return differing


def _change_text(text: str, changes: Mapping[str, Any]) -> str:
    """Change values in a YAML document, and add those that it doesn't have."""
    editor = YAML()
    editor.Resolver = _TextResolver
    editor.preserve_quotes = True
    editor.width = LINE_WIDTH
    start = _HEAD.match(text)
    head = start[0] if start else ""
    try:
        document, indent, dash = load_yaml_guess_indent(text.removeprefix(head), yaml=editor)
    except (YAMLError, ValueError) as error:
        raise ConfigError(f"not valid YAML: {explain_error(error)}") from error

    if not changes:
        return text
    # Loaded by the editor, so that new values have the style of our files.
    additions = editor.load(reading.format_yaml(dict(changes)))
    if document is None:  # the file has no fields, but may have comments
        document = additions
        document.fa.set_block_style()
        head = text if text.endswith("\n") else f"{text}\n"
    else:
        _update(document, additions)
    # Keep the indentation that the file has.
    if indent:
        editor.indent(mapping=indent - (dash or 0), sequence=indent, offset=dash or 0)
    stream = io.StringIO()
    editor.dump(document, stream)
    return head + stream.getvalue()


def _update(present: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Change values of a mapping. Comments next to values stay."""
    for name, value in changes.items():
        old = present.get(name)
        if isinstance(value, dict) and isinstance(old, dict):
            # Fields that differ are listed one by one, but intervals belong together.
            if name == "measured":
                for outdated in old.keys() - value.keys():
                    del old[outdated]
            _update(old, value)
        else:
            # ruamel.yaml puts new text into the quotes of the old text, where null is a name.
            present[name] = None
            present[name] = value
