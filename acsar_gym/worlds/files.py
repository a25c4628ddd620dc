"""Read and write files of worlds: Gazebo's SDF, ROS maps, and this project's JSON or YAML.

The project's own format has the fields of `World` [m, rad]:

    name: three pillars
    circles: [[2.0, 0.3, 0.1], [3.0, -0.4, 0.1]]    # x, y, radius
    segments: [[0.0, 1.0, 4.0, 1.0]]                # x1, y1, x2, y2
    start: {x: 0.0, y: 0.0, theta: 0.0}             # and radius; without theta any heading
    goal: {x: 4.0, y: 0.0}                          # and radius
    path: [[0.0, 0.0], [4.0, 0.0]]                  # optional

A YAML with an `image` is a ROS map; `start` and `goal` must be added to it, other keys are
optional. A Gazebo world is read as one of BARN's: it gets their start and goal, and the path in
`path_N.npy` beside `world_N.world`, or in a folder `path_files` there or above, as in BARN's own
repository. Every file that can't be used raises a WorldError of one line.
"""

from __future__ import annotations

import json
import math
import re
import tokenize
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.errors import WorldError, show_value, suggest_name
from acsar_gym.reading import explain_error
from acsar_gym.worlds import maps, sdf
from acsar_gym.worlds.world import MAX_COORDINATE, MAX_OBSTACLES, Region, World

Floats = NDArray[np.float64]
MAX_IMPORT_BYTES = 64_000_000
"""Most bytes of an SDF file or a picture."""
MAX_TEXT_BYTES = 5_000_000
"""Most bytes of a JSON or YAML; 20,000 segments and a path of 20,000 points are 3 MB."""
MAX_YAML_EVENTS = 210_000
"""Most parser events of a YAML; 20,000 segments and a path of 20,000 points are 200,000."""
MAX_WORLD_FILES = 10_000
"""Most worlds of a folder."""
MAX_FOLDER_OBSTACLES = 1_000_000
"""Most obstacles of all worlds of a folder."""
MAX_NAME = 1_000
"""Most characters of a name."""
KEYS = ("name", "circles", "segments", "start", "goal", "path")
REGION_KEYS = {"start": ("x", "y", "theta", "radius"), "goal": ("x", "y", "radius")}
BARN_START = Region(-2.0, 3.0, 0.0, math.pi / 2.0)
BARN_GOAL = Region(-2.0, 13.0)
BARN_CELL = 0.15
"""Side of a cell of a published path [m]."""
BARN_CORNER = (-4.575, 5.075)
"""Position of cell (0, 0) of a published path [m]."""
NPY_ERRORS = (
    *(OSError, ValueError, TypeError, LookupError, ArithmeticError, SyntaxError, EOFError),
    *(MemoryError, RecursionError, tokenize.TokenError),
)
"""Exceptions that NumPy raises for broken files."""


def load_world(path: Path) -> World:
    """Read a world from a `.world`, `.sdf`, `.yaml`, `.yml` or `.json` file.

    Raises WorldError where it can't be read, and MissingExtraError for a map without Pillow.
    """
    reader = WORLD_READERS.get(path.suffix.lower())
    if reader is None:
        if path.suffix.lower() in maps.PICTURE_SUFFIXES:
            raise WorldError(f"{path}: is a map's picture: pass the YAML that names it")
        raise WorldError(f"{path}: a world is read from {', '.join(WORLD_READERS)}")
    try:
        return reader(path)
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from None


def load_folder(folder: Path) -> list[World]:
    """Read all worlds of a folder in natural order: world_2 comes before world_10.

    Raises WorldError for a folder that is missing, without worlds or with too many, and for the
    first bad file.
    """
    try:
        if not folder.is_dir():
            raise WorldError(f"{folder}: there is no such folder")
        paths = [path for path in folder.iterdir() if _is_world(path)]
    except OSError as error:
        raise WorldError(f"{folder}: can't be read: {explain_error(error)}") from None
    if not paths:
        raise WorldError(f"{folder}: holds no worlds ({', '.join(WORLD_READERS)})")
    if len(paths) > MAX_WORLD_FILES:
        raise WorldError(
            f"{folder}: holds {len(paths):,} worlds, at most {MAX_WORLD_FILES:,} are read"
        )
    return list(_loaded(folder, sorted(paths, key=_natural)))


def _loaded(folder: Path, paths: Iterable[Path]) -> Iterator[World]:
    obstacles = 0
    for path in paths:
        world = load_world(path)
        obstacles += world.obstacles
        if obstacles > MAX_FOLDER_OBSTACLES:
            raise WorldError(
                f"{folder}: holds more than {MAX_FOLDER_OBSTACLES:,} obstacles: use fewer"
            )
        yield world


def save_world(world: World, path: Path) -> None:
    """Write a world in the project's own format; `load` gives the same world.

    Raises WorldError for other suffixes than `.json`, `.yaml` and `.yml`, and where the file can't
    be written.
    """
    if path.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise WorldError(f"{path}: a world is saved as .json, .yaml or .yml")
    write = _as_json if path.suffix.lower() == ".json" else _as_yaml
    try:
        data = write(_fields(world)).encode()
    except UnicodeEncodeError:
        raise WorldError(f"{path}: can't be written: the world's name isn't UTF-8 text") from None
    reading.write_atomically(path, data, WorldError)


def _is_world(path: Path) -> bool:
    return path.suffix.lower() in WORLD_READERS and not path.name.startswith(".")


def _natural(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if part.isdecimal() else part for part in parts], path.name


def _text(path: Path) -> str:
    return reading.decode_text(reading.read_content(path, MAX_TEXT_BYTES, WorldError), WorldError)


def _from_sdf(path: Path) -> World:
    circles, segments = sdf.read_obstacles(reading.read_content(path, MAX_IMPORT_BYTES, WorldError))
    return World(circles, segments, BARN_START, BARN_GOAL, _published_path(path), path.stem)


def _published_path(path: Path) -> Floats | None:
    """The path from start to goal of a published world, from its cells (row, column)."""
    name = path.stem.replace("world_", "path_", 1) + ".npy"
    folders = (path.parent, path.parent / "path_files", path.parent.parent / "path_files")
    found = [folder / name for folder in folders if (folder / name).is_file()]
    if not path.stem.startswith("world_") or not found:
        return None
    cells_file = found[0]
    cells = _cells(cells_file) * BARN_CELL + BARN_CORNER
    ends = ((region.x, region.y) for region in (BARN_START, BARN_GOAL))
    start, goal = map(np.array, ends)
    return np.concatenate([start[None], cells, goal[None]])


def _cells(path: Path) -> Floats:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the file may be of Python 2
            # Mapped, because a header may claim more bytes than the file has.
            cells = np.lib.format.open_memmap(path, mode="r")
    except NPY_ERRORS:
        raise WorldError(f"{path.name}: isn't a sound .npy file: remove or replace it") from None
    if cells.ndim != 2 or cells.shape[1] != 2 or cells.dtype.kind not in "iuf":
        raise WorldError(f"{path.name}: must hold cells (row, column), has shape {cells.shape}")
    if len(cells) > MAX_OBSTACLES or not (np.abs(cells) <= MAX_COORDINATE).all():
        raise WorldError(f"{path.name}: holds too many cells or cells too far away")
    return cells.astype(np.float64)


def _from_json(path: Path) -> World:
    return _from_data(reading.parse_json(_text(path), WorldError), path)


def _from_yaml(path: Path) -> World:
    return _from_data(reading.parse_yaml(_text(path), WorldError, MAX_YAML_EVENTS), path)


def _from_data(data: object, path: Path) -> World:
    if not isinstance(data, dict):
        raise WorldError(f"must be a mapping with {', '.join(KEYS)}")
    name = data.get("name", path.stem)
    if not isinstance(name, str) or len(name) > MAX_NAME:
        raise WorldError(
            f"name: must be text of {MAX_NAME} characters at most, is {show_value(name)}"
        )
    start, goal = (_region(key, data.get(key)) for key in REGION_KEYS)
    circles, segments = _rows(data, "circles", 3), _rows(data, "segments", 4)
    way = None if data.get("path") is None else _rows(data, "path", 2)
    if "image" in data:
        segments = np.concatenate([segments, _outlines(data, path)])
    else:
        _known(data, KEYS)
    return World(circles, segments, start, goal, way, name)


def _outlines(data: Mapping[str, Any], path: Path) -> Floats:
    """Segments of a ROS map."""
    config = maps.read_settings(data)
    try:
        picture = reading.read_content(path.parent / config.image, MAX_IMPORT_BYTES, WorldError)
        return maps.map_segments(picture, config)
    except WorldError as error:
        raise WorldError(f"image {show_value(config.image)}: {error}") from None


def _known(data: Mapping[Any, Any], keys: Iterable[str], where: str = "") -> None:
    for key in data:
        if key not in keys:
            near = key[:40] if isinstance(key, str) else ""
            raise WorldError(f"{where}unknown key {show_value(key)}{suggest_name(near, keys)}")


def _region(name: str, data: object) -> Region:
    """A start or goal: x, y, and optionally radius and theta."""
    keys = REGION_KEYS[name]
    if data is None:
        raise WorldError(f"has no {name}: add a line like '{name}: {{x: 0.0, y: 0.0}}' [m]")
    if not isinstance(data, dict):
        raise WorldError(f"{name}: must be a mapping with {', '.join(keys)}")
    _known(data, keys, f"{name}: ")
    given = {key: value for key, value in data.items() if value is not None}
    for key in ("x", "y", *given):
        if not _is_number(given.get(key)):
            raise WorldError(f"{name}: {key} must be a number, is {show_value(given.get(key))}")
    return Region(**given)


def _is_number(value: object) -> bool:
    """Whether a value is a finite number that isn't too large; True and False aren't numbers."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= MAX_COORDINATE


def _rows(data: Mapping[str, Any], name: str, width: int) -> Floats:
    rows = data.get(name, [])
    if not isinstance(rows, list) or len(rows) > MAX_OBSTACLES:
        raise WorldError(f"{name}: must be a list of at most {MAX_OBSTACLES:,} rows")
    for number, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != width or not all(map(_is_number, row)):
            raise WorldError(
                f"{name}: row {number} must be {width} finite numbers of at most "
                f"{MAX_COORDINATE:g}, "
                f"is {show_value(row)}"
            )
    return np.array(rows, np.float64).reshape(-1, width)


def _fields(world: World) -> dict[str, Any]:
    """The world as numbers and text."""
    start, goal = ({"x": r.x, "y": r.y, "radius": r.radius} for r in (world.start, world.goal))
    if world.start.theta is not None:
        start["theta"] = world.start.theta
    fields: dict[str, Any] = {
        "name": world.name,
        "start": {key: float(value) for key, value in start.items()},
        "goal": {key: float(value) for key, value in goal.items()},
        "circles": world.circles.tolist(),
        "segments": world.segments.tolist(),
    }
    return fields if world.path is None else {**fields, "path": world.path.tolist()}


def _as_json(fields: Mapping[str, Any]) -> str:
    """JSON with one line for each field, and for each row of numbers."""
    lines = (f"  {json.dumps(key)}: {_json_value(value)}" for key, value in fields.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _json_value(value: object) -> str:
    if not isinstance(value, list) or not value:
        return json.dumps(value)
    return "[\n    " + ",\n    ".join(map(json.dumps, value)) + "\n  ]"


def _as_yaml(fields: Mapping[str, Any]) -> str:
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text: str = yaml.dump(
        dict(fields), Dumper=dumper, default_flow_style=None, sort_keys=False, width=200
    )
    return text


WORLD_READERS: dict[str, Callable[[Path], World]] = {
    ".world": _from_sdf,
    ".sdf": _from_sdf,
    ".yaml": _from_yaml,
    ".yml": _from_yaml,
    ".json": _from_json,
}
