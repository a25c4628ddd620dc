"""Write robots as YAML: new files, or the values that differ in a file that somebody has."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from acsar_gym import reading
from acsar_gym.config import files
from acsar_gym.config.parts import GEOMETRY_FIELDS
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, show_value

ROBOT_FILE_HEAD = (
    "# A robot for acsar_gym: its geometry, and what differs from the defaults. SI units.\n"
)
_DROPPED = object()  # stands for the value of a key that is to be removed
_Edit = tuple[int, int, str]
"""Beginning and end of what is replaced in a text, and what by."""


def check_target(path: str | Path, kind: type[Section], *, force: bool = False) -> Path:
    """Return the path of a robot's file that may be written; ConfigError for another one.

    Only with `force` it may be a file that exists and isn't a robot's.
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
    path = check_target(path, type(robot), force=True)
    try:
        present = _read_present(path, type(robot))
    except ConfigError:
        if not force:
            raise
        present = None
    if present is None:
        geometry = {name: getattr(robot, name) for name in GEOMETRY_FIELDS}
        changes = geometry | find_differences(robot, type(robot)())
        text = ROBOT_FILE_HEAD + reading.format_yaml(changes)
    else:
        text, old = present
        for remark in outdated:
            text = text.replace(_comment(remark), "")
        text = _change_text(text, _find_changes(old, robot))
    for name, remark in remarks.items():
        if _comment(remark) not in text:
            lines = _comment(remark).replace("\\", r"\\")
            text = re.sub(f"(?m)^(?={name}:)", lines, text)
    reading.write_atomically(path, text.encode())


def _format_line(data: Any) -> str:
    """Format a value as YAML on one line, for any place in a document."""
    options: dict[str, Any] = {"default_flow_style": True, "allow_unicode": True}
    text: str = yaml.dump([data], Dumper=reading.YamlDumper, width=math.inf, **options)
    return text.strip()[1:-1]


def _comment(remark: str) -> str:
    return "".join(f"# {line}\n" for line in remark.splitlines())


def _read_present(path: Path, kind: type[Section]) -> tuple[str, Section] | None:
    """The text and the robot of a file; None where there is none, ConfigError for another file."""
    if not path.is_file():
        return None
    try:
        text = files.read_text(path)
        return text, kind.model_validate(files.read_own_fields(text))
    except ConfigError as error:
        raise ConfigError(
            f"{path}: is there, and isn't a robot's file, which would be changed in place "
            f"({error}): give another name, or replace it with --force"
        ) from error


def find_differences(section: Section, usual: Section) -> dict[str, Any]:
    """Return the fields of a section that differ from those of another, as plain YAML values."""
    plain = section.model_dump(mode="json")
    differing: dict[str, Any] = {}
    for name, default in usual:
        value = getattr(section, name)
        if value != default:
            nested = isinstance(value, Section)
            differing[name] = (
                find_differences(value, default or type(value)()) if nested else plain[name]
            )
    return differing


# Changes of a text


def _find_changes(old: Section, new: Section) -> dict[str, Any]:
    """What differs, by keys; entries of mappings are told apart, and may be dropped."""
    changes = find_differences(new, old)
    for name, value in changes.items():
        before = getattr(old, name)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            known = old.model_dump(mode="json")[name]
            kept = {key: each for key, each in value.items() if known.get(key) != each}
            changes[name] = dict.fromkeys(known.keys() - value.keys(), _DROPPED) | kept
    return changes


def _change_text(text: str, changes: Mapping[str, Any]) -> str:
    """Change values in a YAML document, and add those it doesn't have; the rest stays."""
    newline = "\r\n" if "\r\n" in text else "\n"
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if isinstance(root, yaml.MappingNode):
        edits = list(_edit_mapping(text, root, changes))
    else:
        edits = [_add_lines(text, len(text), changes)] if changes else []
    for start, end, replacement in sorted(edits, reverse=True, key=lambda edit: edit[:2]):
        text = text[:start] + replacement.replace("\n", newline) + text[end:]
    return text


def _edit_mapping(text: str, node: yaml.MappingNode, changes: Mapping[str, Any]) -> Iterator[_Edit]:
    """Yield what to replace in a mapping."""
    entries = {key.value: value for key, value in node.value}
    dropped = {name for name, value in changes.items() if value is _DROPPED}
    added = {k: v for k, v in changes.items() if k not in entries and k not in dropped}
    if node.value and not entries.keys() - dropped:
        first, last = node.value[0][0].start_mark.index, _find_end(node.value[-1][1])
        line = _format_line(added)
        yield first, last, line[1:-1] if node.flow_style else line
        return
    for name in changes.keys() & entries.keys() - dropped:
        yield from _edit_value(text, entries[name], changes[name])
    yield from _remove_entries(text, node, dropped)
    if added:
        yield _add_entries(text, node, added)


def _edit_value(text: str, node: yaml.Node, value: Any) -> Iterator[_Edit]:
    """Yield what to replace where a value has changed; of a list as long as before, its items."""
    if isinstance(node, yaml.MappingNode) and isinstance(value, Mapping) and node.value:
        yield from _edit_mapping(text, node, value)
    elif (
        isinstance(node, yaml.SequenceNode)
        and isinstance(value, list)
        and (len(node.value) == len(value))
    ):
        for child, item in zip(node.value, value, strict=True):
            yield from _edit_value(text, child, item)
    else:
        start, end = node.start_mark.index, _find_end(node)
        line = _format_line(value)
        is_scalar = isinstance(node, yaml.ScalarNode)
        if not is_scalar or reading.parse_yaml(text[start:end]) != value:
            yield start, end, line if end > start else f" {line}"


def _find_end(node: yaml.Node) -> int:
    """Where the text of a node ends, without the comments behind it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _find_end(last[1] if isinstance(node, yaml.MappingNode) else last)
    return int(node.end_mark.index)


def _add_entries(text: str, node: yaml.MappingNode, added: Mapping[str, Any]) -> _Edit:
    """Add entries behind the last one of a mapping."""
    line = _format_line(dict(added))[1:-1]
    if not node.value:
        end = node.end_mark.index - 1
        return end, end, line
    end = _find_end(node.value[-1][1])
    if node.flow_style:
        return end, end, f", {line}"
    return _add_lines(text, end, added, node.value[0][0].start_mark.column)


def _add_lines(text: str, end: int, added: Mapping[str, Any], column: int = 0) -> _Edit:
    """Add entries of a block mapping, below the line in which something ends."""
    lines = []
    for name, value in added.items():
        if isinstance(value, list | Mapping):
            lines += reading.format_yaml({name: value}).splitlines()
        else:
            lines.append(f"{name}: {_format_line(value)}")
    block = "".join(f"{' ' * column}{line}\n" for line in lines)
    if end == 0 or text[end - 1] == "\n":
        return end, end, block
    place = text.find("\n", end) + 1
    return (place, place, block) if place else (len(text), len(text), f"\n{block}")


def _remove_entries(text: str, node: yaml.MappingNode, names: set[str]) -> Iterator[_Edit]:
    """Remove entries of a mapping, with their lines or commas; some others stay."""
    starts = [key.start_mark.index for key, _ in node.value]
    ends = [_find_end(value) for _, value in node.value]
    kept = [n for n, (key, _) in enumerate(node.value) if key.value not in names]
    for n in (n for n in range(len(starts)) if n not in kept):
        if not node.flow_style:
            line_end = text.find("\n", ends[n])
            start = starts[n] - node.value[n][0].start_mark.column
            yield start, len(text) if line_end < 0 else line_end + 1, ""
        elif n < kept[-1]:
            yield starts[n], starts[n + 1], ""
        else:
            yield ends[n - 1], ends[n], ""
