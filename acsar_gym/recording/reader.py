"""Reads recordings back: whole where they fit into memory, and else what is asked for."""

from __future__ import annotations

import hashlib
import os
import warnings
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, overload

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning, escape_unprintable
from acsar_gym.reading import open_file
from acsar_gym.recording.episodes import (
    GROUP_OF_FIELD,
    LIST_TOPICS,
    TABLE_TOPICS,
    EpisodeCollector,
    EpisodeParts,
    FieldGroup,
    check_stamps,
    describe_parts,
    join_truth,
    make_episode,
    make_movers,
    make_scans,
    make_steps,
    make_ticks,
    make_truth,
    make_wire,
    parse_content,
    parse_revolution,
    to_integers,
)
from acsar_gym.recording.messages import (
    ACTION,
    EXCHANGES,
    MOVERS,
    REVOLUTIONS,
    SCANS,
    TICKS,
    WIRE_RECEIVED,
    WIRE_SENT,
    Topic,
)
from acsar_gym.recording.stream import MESSAGE, MESSAGE_HEAD, FileCut, RecordStream
from acsar_gym.recording.types import Episode, Floats, Recording, Revolutions

KEPT_BYTES = 60_000_000  # less content than this is kept in memory; at 100 Hz that of 20 minutes
CACHED_BYTES = 200_000_000  # most bytes of a larger recording that are kept for another look
BLOCK_BYTES = 4_000_000  # of a large recording, about so many are read at once, where all are read
CARRIED_ROWS = 64  # exchanges of the block before that a tick may belong to


def read(path: str | Path, *, revolutions: bool = False) -> Recording:
    """Read a recording.

    A long one isn't read into memory: its episodes are read from the file where they are asked for,
    some fields at a time, and forgotten where others take their place.

    Warns (RecordingWarning) where damaged parts were left out.

    Args:
        path: the file, of any length.
        revolutions: whether what a LiDAR measured is wanted, too.

    Returns:
        All of it. Where the end of the file is missing, what there is, and `cut` is true; where
        something is damaged, what isn't, and `damages` tell it.

    Raises:
        ConfigError: the file can't be read, isn't a recording, or nothing of it is whole. Episodes
            of a long recording may raise it when they are read.
    """
    return _read_counted(Path(path), revolutions=revolutions)[0]


def _read_counted(
    path: Path, *, revolutions: bool
) -> tuple[Recording, list[EpisodeParts], dict[str, int]]:
    """Read a recording; also how much there is of each episode, and of each topic."""
    wanted = (*TABLE_TOPICS, *LIST_TOPICS, *((REVOLUTIONS,) if revolutions else ()))
    with open_file(path) as file:
        collector = EpisodeCollector(wanted)
        stream = RecordStream(file, collector.topics)
        cut: FileCut | None = None
        try:
            for opcode, content in stream:
                collector.take(opcode, content, stream.at, stream.index)
                if collector.kept > KEPT_BYTES:
                    collector.forget()
        except FileCut as error:
            cut = error
        damages = (*collector.damages, *stream.damages)
        if cut is not None and cut.damaged:
            damages += (f"all from byte {stream.at:,} on",)
        parts = [one for one in collector.parts if one.start == one.start]
        if collector.header is None or not parts:
            raise ConfigError(_explain_nothing(collector, damages, is_cut=cut is not None))
        config = RobotConfig.model_validate(collector.header["config"])
        if collector.is_whole:
            episodes = tuple(map(make_episode, parts))
        else:
            collector.forget()
            source = EpisodeSource(path, file, collector.topics)
            episodes = tuple(source.make_lazy(one) for one in parts)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()[:16]
    missing = sum(one.missing for one in parts)
    dropped = (collector.end or {}).get("dropped", 0)
    dropped = dropped if isinstance(dropped, int) and dropped > 0 else 0
    recording = Recording(
        collector.header,
        digest,
        config,
        episodes,
        cut=cut is not None or collector.end is None,
        dropped=dropped or (0 if damages else missing),
        damages=damages,
        missing=max(missing - dropped, 0) if damages else 0,
    )
    if damages:
        text = f"{path}: is damaged: {recording.describe_damage()}"
        warnings.warn(escape_unprintable(text), RecordingWarning, stacklevel=3)
    counts = {name: stream.counts[number] for number, name in collector.names.items()}
    return recording, parts, {name: count for name, count in counts.items() if count}


def _explain_nothing(collector: EpisodeCollector, damages: Sequence[str], *, is_cut: bool) -> str:
    if collector.header is not None:
        if damages:
            return f"is damaged: holds no episode but {damages[0]}"
        return "is cut before its first episode" if is_cut else "holds no episode"
    if collector.problem:
        return collector.problem
    return f"is damaged: {damages[0]}" if damages else "isn't a recording of acsar_gym"


class RecordedEpisode(Episode):
    """An episode whose fields are read from the file when they are asked for."""

    _source: EpisodeSource
    _parts: EpisodeParts

    def __getattr__(self, name: str) -> Any:
        """Read a field that isn't in memory."""
        group = GROUP_OF_FIELD.get(name)
        if group is None or "_source" not in self.__dict__:
            raise AttributeError(name)
        self._source.load(self, group)
        return self.__dict__[name]

    def __repr__(self) -> str:
        return f"<episode from {self.start:g} s on, read when it is asked for>"

    def iterate_blocks(self) -> Iterator[Episode]:
        """Yield ticks, truth, movers and wire in blocks."""
        return self._source.iterate_blocks(self._parts)


class EpisodeSource:
    """A recording's file, from which episodes are read piece by piece."""

    def __init__(self, path: Path, file: IO[bytes], topics: dict[int, Topic]) -> None:
        self._path = path
        self._identity = _identify_file(file)
        self._topics = dict(topics)
        self._loaded: deque[tuple[RecordedEpisode, list[str], int]] = deque()

    def make_lazy(self, parts: EpisodeParts) -> RecordedEpisode:
        """Make an episode that is read when it is asked for."""
        episode = object.__new__(RecordedEpisode)
        episode.__dict__.update(describe_parts(parts), _source=self, _parts=parts)
        return episode

    def load(self, episode: RecordedEpisode, group: FieldGroup) -> None:
        """Read a group of fields; others are forgotten where there are too many."""
        parts = episode._parts  # noqa: SLF001 - made here
        size = sum(parts.sizes[t.name] + 24 * parts.counts[t.name] for t in group.topics)
        while self._loaded and size + sum(one[2] for one in self._loaded) > CACHED_BYTES:
            other, names, _ = self._loaded.popleft()
            for name in names:
                other.__dict__.pop(name, None)
        if REVOLUTIONS in group.topics and size > BLOCK_BYTES:
            fields: dict[str, Any] = {"revolutions": self._list_revolutions(parts)}
            size = 0
        elif not size:
            fields = group.make(parts.make_blank())
        else:
            fields = group.make(self._read_parts(parts, group.topics, parts.places))
        if group.make is make_truth:  # the tables that it is made of aren't kept
            size = 24 * parts.counts[TICKS.name]
        episode.__dict__.update(fields)
        self._loaded.append((episode, list(fields), size))

    def _read_parts(
        self, parts: EpisodeParts, topics: Sequence[Topic], places: Sequence[list[int]]
    ) -> EpisodeParts:
        read_parts = parts.make_blank()
        for _ in self._fill_parts(read_parts, topics, places):
            pass
        return read_parts

    def _fill_parts(
        self, parts: EpisodeParts, topics: Sequence[Topic], places: Sequence[list[int]]
    ) -> Iterator[int]:
        """Read topics of an episode chunk by chunk into `parts`; yields how many bytes that was."""
        wanted = {number: topic for number, topic in self._topics.items() if topic in topics}
        with open_file(self._path) as file:
            if _identify_file(file) != self._identity:
                raise ConfigError("has changed since it was read: read it again")
            stream = RecordStream(file, wanted)
            for at, first, last in places:
                size = 0
                for opcode, content in stream.read_again(at):
                    if opcode == MESSAGE and first <= stream.index <= last:
                        channel, _, time, _ = MESSAGE_HEAD.unpack_from(content)
                        if channel in wanted:
                            data = parse_content(wanted[channel], content[MESSAGE_HEAD.size :])
                            parts.buffers[wanted[channel].name].add(time, data)
                            size += len(data)
                yield size

    def iterate_blocks(self, parts: EpisodeParts) -> Iterator[Episode]:
        """Yield ticks, truth, movers and wire of an episode in blocks."""
        block, carried = parts.make_blank(), np.zeros((0, len(EXCHANGES.columns)))
        topics, size = (TICKS, EXCHANGES, MOVERS, WIRE_SENT, WIRE_RECEIVED), 0
        fields = describe_parts(parts) | make_steps(block) | make_scans(block)
        for number, read_bytes in enumerate(self._fill_parts(block, topics, parts.places), 1):
            size += read_bytes
            if size < BLOCK_BYTES and number < len(parts.places):
                continue
            exchanges = np.concatenate([carried, block.table(EXCHANGES)])
            carried = exchanges[-CARRIED_ROWS:].copy()
            truth = join_truth(block.table(TICKS), exchanges)
            fields |= make_ticks(block) | make_movers(block) | make_wire(block)
            yield Episode(**fields | {"truth": truth})
            block.buffers.clear()
            size = 0

    def _list_revolutions(self, parts: EpisodeParts) -> Revolutions:
        """List the revolutions of an episode; what was measured is read when it is asked for."""
        heads: list[tuple[float, ...]] = []
        ends: list[int] = []
        read_parts = parts.make_blank()
        for _ in self._fill_parts(read_parts, (REVOLUTIONS,), parts.places):
            turns = read_parts.buffers.pop(REVOLUTIONS.name, None)
            heads += (
                tuple(parse_revolution(turn)[0]) for turn in (turns.pieces() if turns else ())
            )
            ends.append(len(heads))
        rows = np.array(heads, np.float64).reshape(-1, 2)
        measured = StoredRevolutions(self, parts, ends)
        return Revolutions(check_stamps(rows[:, 1]), measured, to_integers(rows[:, 0]))

    def read_revolutions(self, parts: EpisodeParts, chunk: int) -> list[Floats]:
        """Read what was measured in the revolutions of one chunk of an episode."""
        read_parts = self._read_parts(parts, (REVOLUTIONS,), parts.places[chunk : chunk + 1])
        turns = read_parts.buffers[REVOLUTIONS.name].pieces()
        return [parse_revolution(turn)[1] for turn in turns]


def _identify_file(file: IO[bytes]) -> tuple[int, ...]:
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


class StoredRevolutions(Sequence[Floats]):
    """What was measured in each revolution of a long episode, read chunk by chunk."""

    def __init__(self, source: EpisodeSource, parts: EpisodeParts, ends: list[int]) -> None:
        self._source, self._parts, self._ends = source, parts, ends
        self._chunk = -1
        self._turns: list[Floats] = []

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    @overload
    def __getitem__(self, place: int) -> Floats: ...
    @overload
    def __getitem__(self, place: slice) -> list[Floats]: ...
    def __getitem__(self, place: int | slice) -> Floats | list[Floats]:
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        number = range(len(self))[place]
        chunk = bisect_right(self._ends, number)
        if chunk != self._chunk:
            self._turns = self._source.read_revolutions(self._parts, chunk)
            self._chunk = chunk
        return self._turns[number - (self._ends[chunk - 1] if chunk else 0)]


def iterate_blocks(episode: Episode) -> Iterator[Episode]:
    """Yield ticks, truth, movers and wire of an episode in blocks, one after the other.

    They are of moderate size. Steps and scans are those of the whole episode where there is one
    block only, and else empty.
    """
    if isinstance(episode, RecordedEpisode):
        yield from episode.iterate_blocks()
    else:
        yield episode


def summarize(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON; ConfigError if it can't be read."""
    with warnings.catch_warnings():  # the summary says it
        warnings.simplefilter("ignore", RecordingWarning)
        recording, counted, topics = _read_counted(path, revolutions=False)
    header = recording.header
    episodes: list[dict[str, Any]] = [
        {
            "ticks": parts.counts[TICKS.name],
            "steps": parts.counts[ACTION.name],
            "scans": parts.counts[SCANS.name],
            "duration": round(parts.end - parts.start, 3),
            "info": dict(parts.info),
        }
        for parts in counted
    ]
    return {
        "file": str(path),
        "sha256": recording.sha256,
        "whole": not recording.cut,
        "damage": recording.describe_damage(),
        "dropped": None if recording.cut and not recording.dropped else recording.dropped,
        "duration": round(sum(one["duration"] for one in episodes), 3),
        "about": header["about"],
        "robot": {
            "sha256": header["config_sha256"][:16],
            "base_frame": recording.config.base_frame,
            "simulated": any(parts.simulated for parts in counted),
        },
        "versions": header["versions"],
        "created": header["created"],
        "topics": topics,
        "episodes": episodes,
    }


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    about, robot, episodes = summary["about"], summary["robot"], summary["episodes"]
    kind = "simulated" if robot["simulated"] else "real"
    whole = "whole" if summary["whole"] else "cut: what followed is missing"
    if summary["damage"]:
        whole = "damaged" if summary["whole"] else f"damaged; {whole}"
    count = f"{len(episodes)} episode{'s' if len(episodes) != 1 else ''}"
    lost = "drops unknown"  # the end, which would tell them, is missing
    if summary["dropped"] is not None:
        least = "" if summary["whole"] else "at least "
        lost = f"{least}{summary['dropped']:,} dropped" if summary["dropped"] else "nothing dropped"
    lines = [
        f"{summary['file']}: {whole}; {count}, {summary['duration']:.1f} s, {lost}",
        f"{kind} robot, config {robot['sha256']}; file {summary['sha256']}",
    ]
    if summary["damage"]:
        lines.append(summary["damage"])
    if about:
        lines.append(", ".join(f"{name} {_shorten(value)}" for name, value in about.items()))
    lines += [
        f"episode {number}: {one['duration']:.1f} s, {one['ticks']:,} ticks, "
        f"{one['steps']} steps, {one['scans']} scans; {_shorten(one['info'])}"
        for number, one in enumerate(episodes[:20])
    ]
    if len(episodes) > 20:
        lines.append(f"... and {len(episodes) - 20} more episodes")
    return lines + [f"{name:<20} {count:>9,}" for name, count in summary["topics"].items()]


def _shorten(value: Any) -> str:
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return escape_unprintable(text, 100)
