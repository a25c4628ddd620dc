"""Read how things move in Gazebo: the scripts of actors, and the key frames in a plugin's source.

An actor is a person who follows the waypoints of its trajectories, which are given in the frame of
the world. A plugin such as DynaBARN's moves its model by a PoseAnimation, whose key frames are read
from the plugin's C++ source: it is looked for as NAME.cc, for a plugin libNAME.so, in the world's
folder, the folders of models, those of GAZEBO_PLUGIN_PATH, and `plugins` in any of them or above.
Both interpolate by a spline. Lengths in m, times in s.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from acsar_gym import reading
from acsar_gym.errors import WorldError
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk
from acsar_gym.worlds.sdf_shapes import Shape, read_numbers

PLUGIN_VARIABLES = ("GZ_SIM_SYSTEM_PLUGIN_PATH", "GAZEBO_PLUGIN_PATH")
"""Environment variables in which Gazebo finds plugins."""
MAX_SOURCE_BYTES = 1_000_000  # most bytes of a plugin's source
_NUMBER = r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)f?\s*"
_COMMENTS = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_ANIMATION = re.compile(rf"PoseAnimation\s*\([^,;()]*,{_NUMBER},\s*(true|false)\s*\)")
_TIME = re.compile(rf"{_NUMBER}\)")
_PLACE = re.compile(rf"Translation\s*\(\s*[\w:]*Vector3d?\s*\({_NUMBER},{_NUMBER},{_NUMBER}\)\s*\)")


class Keys(NamedTuple):
    """The key frames of a PoseAnimation."""

    times: list[float]
    """Growing, at least two, from 0 on."""
    points: list[list[float]]
    """Where the model's origin is."""
    height: float
    """Of the model's origin above the floor, in the first frame."""
    duration: float
    """At its end the animation stops, or begins anew."""
    loops: bool


def read_actor(actor: Element, name: str) -> Mover | None:
    """Make a mover of an actor; None where it has no waypoints, WorldError for bad ones."""
    script, what = actor.find("script"), f"actor {name!r}"
    if script is None:
        return None
    trajectories = (_read_trajectory(each, what) for each in script.iterfind("trajectory"))
    motions = [motion for motion in trajectories if motion is not None]
    if not motions:
        return None
    pieces: list[list[float]] = []
    now, last = 0.0, [0.0, 0.0]
    delay = _read_seconds(script.find("delay_start"), "delay_start", what)
    for begin, mover in sorted(motions, key=lambda motion: motion[0]):
        first = [float(mover.pieces[0, 1]), float(mover.pieces[0, 5])]
        begins = begin + delay
        if begins < now - 1e-9:
            raise WorldError(f"{what}: its trajectories overlap in time")
        if begins > now + 1e-9:
            x, y = last if pieces else first
            pieces.append([now, x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0])
        pieces += [[begins + row[0], *row[1:]] for row in mover.pieces.tolist()]
        now = begins + mover.duration
        last = list(mover.position(mover.duration))
    loops = (script.findtext("loop") or "true").strip() in ("true", "1")
    starts = (script.findtext("auto_start") or "true").strip() in ("true", "1")
    if not starts:
        return walk([[pieces[0][1], pieces[0][5]]], name=name)
    pieces[0][0] = 0.0
    return Mover(np.array(pieces), now, repeat=Repeat.LOOP if loops else Repeat.STOP, name=name)


def _read_trajectory(trajectory: Element, what: str) -> tuple[float, Mover] | None:
    """When a trajectory begins, and its motion, which stops at its end; None without waypoints."""
    rows = []
    for waypoint in trajectory.iterfind("waypoint"):
        time = _read_seconds(waypoint.find("time"), "time", what)
        pose = waypoint.find("pose")
        x, y, *_ = read_numbers(pose, "pose of a waypoint", 6, what)
        rows.append((time, x, y))
    if not rows:
        return None
    times, xs, ys = np.array(sorted(rows)).T.tolist()
    if len(times) == 1:
        times, xs, ys = [times[0], times[0] + 1.0], xs * 2, ys * 2
    try:
        tension = min(max(float(trajectory.get("tension", "0")), 0.0), 1.0)
    except ValueError as error:
        raise WorldError(f"{what}: the tension of a trajectory must be a number") from error
    points = np.column_stack([xs, ys])
    return times[0], follow_keys(
        times, points, smooth=True, tension=tension, repeat=Repeat.STOP, name=what
    )


def _read_seconds(element: Element | None, tag: str, what: str) -> float:
    """A time that isn't negative; 0 where there is none."""
    if element is None:
        return 0.0
    (seconds,) = read_numbers(element, tag, 1, what)
    if seconds < 0.0:
        raise WorldError(f"{what}: {tag} must not be negative, is {seconds:g}")
    return seconds


def find_keys(plugin: Element, folders: Sequence[Path]) -> Keys | None:
    """Find the key frames of a plugin in its source; None where it isn't there, or has none."""
    library = PurePosixPath(plugin.get("filename", "")).name.removesuffix(".so")
    variables = (os.environ.get(name, "") for name in PLUGIN_VARIABLES)
    named = [Path(part) for text in variables for part in text.split(os.pathsep) if part]
    for name in dict.fromkeys((library.removeprefix("lib"), library)):
        for folder in (*folders, *named):
            around = (folder, folder.parent)
            for place in (*around, *(up / "plugins" for up in around)):
                source = place / f"{name}.cc"
                if name and source.is_file():
                    content = reading.read_content(source, MAX_SOURCE_BYTES, WorldError)
                    return parse_keys(content.decode(errors="replace"))
    return None


def parse_keys(source: str) -> Keys | None:
    """Read the key frames in a plugin's C++ source; None where they aren't written as numbers."""
    text = _COMMENTS.sub("", source)
    animation = _ANIMATION.search(text)
    frames: dict[float, list[float]] = {}
    for part in text.split("CreateKeyFrame(")[1:]:
        time, place = _TIME.match(part), _PLACE.search(part)
        if time is None or place is None:
            return None
        frames[float(time[1])] = [float(number) for number in place.groups()]
    if animation is None or len(frames) < 2:
        return None
    duration, loops = float(animation[1]), animation[2] == "true"
    times = sorted(frames)
    places = [frames[time] for time in times]
    if times[0] > 0.0:
        times, places = [0.0, *times], [places[0], *places]
    if times[-1] < duration:  # Gazebo goes on to the first frame
        times, places = [*times, duration], [*places, places[0]]
    return Keys(times, [place[:2] for place in places], places[0][2], duration, loops)


def move_bodies(bodies: Sequence[Shape], keys: Keys, name: str) -> list[Mover]:
    """Move the outline of a model, given in its own frame, along key frames.

    A round body keeps its place in the model, anything else becomes the disc around the model's
    origin. Empty where there is no body.
    """
    circles = [circle for some, _ in bodies for circle in some]
    segments = [segment for _, some in bodies for segment in some]
    if not circles and not segments:
        return []
    if len(circles) == 1 and not segments:
        ((x, y, radius),) = circles
    else:
        ends = np.array(segments).reshape(-1, 2)
        reaches = [math.hypot(cx, cy) + r for cx, cy, r in circles]
        x, y, radius = 0.0, 0.0, max([*reaches, *np.hypot(*ends.T).tolist()])
    repeat = Repeat.LOOP if keys.loops else Repeat.STOP
    points = np.array(keys.points) + np.array([x, y])
    mover = follow_keys(keys.times, points, smooth=True, repeat=repeat, radius=radius, name=name)
    within = mover.pieces[mover.pieces[:, 0] < keys.duration]
    return [replace(mover, pieces=within, duration=keys.duration)]
