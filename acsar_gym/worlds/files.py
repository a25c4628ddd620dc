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
import re
import tokenize
import warnings
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import ConfigDict, Field

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, WorldError, show_value
from acsar_gym.worlds import maps, sdf
from acsar_gym.worlds.generators import BARN_GOAL, BARN_START
from acsar_gym.worlds.world import MAX_COORDINATE, MAX_OBSTACLES, Floats, Region, World

MAX_IMPORT_BYTES = 64_000_000
"""Most bytes of an SDF file or a picture."""
MAX_TEXT_BYTES = 5_000_000
"""Most bytes of a JSON or YAML; 20,000 segments and a path of 20,000 points are 3 MB."""
MAX_YAML_EVENTS = 210_000
"""Most parser events of a YAML; 20,000 segments and a path of 20,000 points are 200,000."""
MAX_KEYS = 100
"""Most keys of a mapping."""
MAX_WORLD_FILES = 10_000
"""Most worlds of a folder."""
MAX_FOLDER_OBSTACLES = 1_000_000
"""Most obstacles of all worlds of a folder."""
BARN_CELL = 0.15
"""Side of a cell of a published path [m]."""
BARN_CORNER = (-4.575, 5.075)
"""Position of cell (0, 0) of a published path [m]."""
NPY_ERRORS = (
    *(OSError, ValueError, TypeError, LookupError, ArithmeticError, SyntaxError, EOFError),
    *(MemoryError, RecursionError, tokenize.TokenError),
)
"""Exceptions that NumPy raises for broken files."""
WORLD_SUFFIXES = (".world", ".sdf", ".yaml", ".yml", ".json")

Coordinate = Annotated[float, Field(strict=True, ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Radius = Annotated[float, Field(strict=True, ge=0.0, le=MAX_COORDINATE)]
Rows: Any = Field(default_factory=list, max_length=MAX_OBSTACLES)


class Goal(Section):
    """A goal in a file [m]."""

    section = "goal"
    x: Coordinate
    y: Coordinate
    radius: Radius | None = None


class Start(Goal):
    """A start in a file [m, rad]."""

    section = "start"
    theta: Coordinate | None = None


class WorldFile(Section):
    """The project's own format; a ROS map has further keys."""

    name: str = Field(max_length=1000)
    start: Start
    goal: Goal
    circles: list[tuple[Coordinate, Coordinate, Radius]] = Rows
    segments: list[tuple[Coordinate, Coordinate, Coordinate, Coordinate]] = Rows
    path: list[tuple[Coordinate, Coordinate]] | None = Field(None, max_length=MAX_OBSTACLES)


class MapFile(WorldFile):
    """A ROS map with a start and a goal; `maps` reads the other keys."""

    model_config = ConfigDict(extra="ignore")


def load_world(path: Path) -> World:
    """Read a world from a `.world`, `.sdf`, `.yaml`, `.yml` or `.json` file.

    Raises WorldError where it can't be read, and MissingExtraError for a map without Pillow.
    """
    suffix = path.suffix.lower()
    if suffix in maps.PICTURE_SUFFIXES:
        raise WorldError(f"{path}: is a map's picture: pass the YAML that names it")
    if suffix not in WORLD_SUFFIXES:
        raise WorldError(f"{path}: a world is read from {', '.join(WORLD_SUFFIXES)}")
    try:
        if suffix in (".world", ".sdf"):
            circles, segments = sdf.read_obstacles(
                reading.read_content(path, MAX_IMPORT_BYTES, WorldError)
            )
            return World(circles, segments, BARN_START, BARN_GOAL, _barn_path(path), path.stem)
        content = reading.read_content(path, MAX_TEXT_BYTES, WorldError)
        text = reading.decode_text(content, WorldError)
        if suffix == ".json":
            return _parse_world(reading.parse_json(text, WorldError), path)
        return _parse_world(reading.parse_yaml(text, WorldError, MAX_YAML_EVENTS), path)
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
        paths = [path for path in folder.iterdir() if path.suffix.lower() in WORLD_SUFFIXES]
    except OSError as error:
        raise WorldError(f"{folder}: can't be read: {reading.explain_error(error)}") from None
    paths = [path for path in paths if not path.name.startswith(".")]
    if not paths:
        raise WorldError(f"{folder}: holds no worlds ({', '.join(WORLD_SUFFIXES)})")
    if len(paths) > MAX_WORLD_FILES:
        raise WorldError(
            f"{folder}: holds {len(paths):,} worlds, at most {MAX_WORLD_FILES:,} are read"
        )

    def natural(path: Path) -> tuple[list[str | int], str]:
        parts = re.split(r"(\d+)", path.name)
        return [int(part) if part.isdecimal() else part for part in parts], path.name

    worlds: list[World] = []
    obstacles = 0
    for path in sorted(paths, key=natural):
        worlds.append(load_world(path))
        obstacles += worlds[-1].obstacles
        if obstacles > MAX_FOLDER_OBSTACLES:
            raise WorldError(
                f"{folder}: holds more than {MAX_FOLDER_OBSTACLES:,} obstacles: use fewer"
            )
    return worlds


def save_world(world: World, path: Path) -> None:
    """Write a world in the project's own format; `load_world` gives the same world.

    Raises WorldError for other suffixes than `.json`, `.yaml` and `.yml`, and where the file can't
    be written.
    """
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
    if world.path is not None:
        fields["path"] = world.path.tolist()
    suffix = path.suffix.lower()
    if suffix not in (".json", ".yaml", ".yml"):
        raise WorldError(f"{path}: a world is saved as .json, .yaml or .yml")
    try:
        if suffix == ".json":
            lines = [f"  {json.dumps(key)}: {_format_json(value)}" for key, value in fields.items()]
            text = "{\n" + ",\n".join(lines) + "\n}\n"
        else:
            dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
            text = yaml.dump(
                fields, Dumper=dumper, default_flow_style=None, sort_keys=False, width=200
            )
        data = text.encode()
    except UnicodeEncodeError:
        raise WorldError(f"{path}: can't be written: the world's name isn't UTF-8 text") from None
    reading.write_atomically(path, data, WorldError)


def _format_json(value: object) -> str:
    """JSON with a line for each row of numbers."""
    if not isinstance(value, list) or not value:
        return json.dumps(value)
    return "[\n    " + ",\n    ".join(map(json.dumps, value)) + "\n  ]"


def _parse_world(data: object, path: Path) -> World:
    """Make a world of the content of a JSON or YAML file."""
    if not isinstance(data, dict):
        raise WorldError(f"must be a mapping with {', '.join(WorldFile.model_fields)}")
    for end in ("start", "goal"):
        if data.get(end) is None:
            raise WorldError(f"has no {end}: add a line like '{end}: {{x: 0.0, y: 0.0}}' [m]")
    for mapping in (data, data["start"], data["goal"]):
        if isinstance(mapping, dict) and len(mapping) > MAX_KEYS:
            raise WorldError(f"has {len(mapping):,} keys, at most {MAX_KEYS} are read")
    model = MapFile if "image" in data else WorldFile
    try:
        file = model.model_validate({"name": path.stem, **data})
    except WorldError:
        raise
    except ConfigError as error:
        raise WorldError(str(error)) from None
    start, goal = file.start, file.goal
    segments = np.array(file.segments, np.float64).reshape(-1, 4)
    if model is MapFile:
        config = maps.read_settings(data)
        try:
            picture = reading.read_content(path.parent / config.image, MAX_IMPORT_BYTES, WorldError)
            segments = np.concatenate([segments, maps.map_segments(picture, config)])
        except WorldError as error:
            raise WorldError(f"image {show_value(config.image)}: {error}") from None
    return World(
        np.array(file.circles, np.float64),
        segments,
        Region(start.x, start.y, start.radius or 0.0, start.theta),
        Region(goal.x, goal.y, goal.radius or 0.0),
        None if file.path is None else np.array(file.path, np.float64),
        file.name,
    )


def _barn_path(path: Path) -> Floats | None:
    """The path from start to goal of a published world, from its cells (row, column)."""
    name = path.stem.replace("world_", "path_", 1) + ".npy"
    folders = (path.parent, path.parent / "path_files", path.parent.parent / "path_files")
    found = [folder / name for folder in folders if (folder / name).is_file()]
    if not path.stem.startswith("world_") or not found:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the file may be of Python 2
            # Mapped, because a header may claim more bytes than the file has.
            cells = np.lib.format.open_memmap(found[0], mode="r")
    except NPY_ERRORS:
        raise WorldError(f"{name}: isn't a sound .npy file: remove or replace it") from None
    if cells.ndim != 2 or cells.shape[1] != 2 or cells.dtype.kind not in "iuf":
        raise WorldError(f"{name}: must hold cells (row, column), has shape {cells.shape}")
    if len(cells) > MAX_OBSTACLES or not (np.abs(cells) <= MAX_COORDINATE).all():
        raise WorldError(f"{name}: holds too many cells or cells too far away")
    start, goal = ([[region.x, region.y]] for region in (BARN_START, BARN_GOAL))
    return np.concatenate([start, cells.astype(np.float64) * BARN_CELL + BARN_CORNER, goal])
