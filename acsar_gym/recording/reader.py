"""Reads recordings back: whole where they fit into memory, and else what is asked for."""

from __future__ import annotations

import hashlib
import os
import warnings
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, overload

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning, escape_unprintable, shorten_text
from acsar_gym.reading import open_file
from acsar_gym.recording.episodes import (
    FIELD_GROUPS,
    LIST_TOPICS,
    TABLE_TOPICS,
    ChunkPlace,
    EpisodeCollector,
    EpisodeParts,
    FieldGroup,
    check_stamps,
    describe_parts,
    join_truth,
    make_episode,
    make_ticks,
    make_wire,
    parse_revolution,
    to_integers,
)
from acsar_gym.recording.messages import (
    ACTION,
    EPISODE,
    EXCHANGES,
    REVOLUTIONS,
    SCANS,
    TICKS,
    WIRE_RECEIVED,
    WIRE_SENT,
    Topic,
)
from acsar_gym.recording.stream import CHANNEL, MESSAGE, FileCut, RecordStream, parse_record
from acsar_gym.recording.types import Episode, Floats, Pieces, Recording, Revolutions

KEPT_BYTES = 100_000_000
"""Recordings with less content than this are kept in memory; at 100 Hz that is half an hour."""
CACHED_BYTES = 200_000_000
"""Most bytes of a larger recording that are kept for when they are asked for again."""
BLOCK_BYTES = 4_000_000
"""About so many bytes of a large recording are read at once by `iterate_blocks`."""
CARRIED_ROWS = 64
"""Exchanges of the block before that a tick may belong to."""
DIGEST_BLOCK = 1 << 20
GROUP_OF_FIELD = {name: group for group in FIELD_GROUPS for name in group.fields}


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
    with open_file(path, None) as file:
        collector = EpisodeCollector(wanted)
        names: dict[int, str] = {}
        stream, cut = _collect(file, collector, names)
        if not collector.topics and stream.damages and collector.header is not None:
            collector = EpisodeCollector(wanted)  # the chunk with the channels is damaged
            stream = RecordStream(file)
            for opcode, content in stream.read_summary():
                _take(collector, names, opcode, content, 0)
            stream, cut = _collect(file, collector, names)
        damages = (*collector.damages, *stream.damages)
        if cut is not None and cut.damaged:
            damages += (f"all from byte {stream.at:,} on",)
        if collector.header is None:
            found = f"is damaged: {damages[0]}" if damages else "isn't a recording of acsar_gym"
            raise ConfigError(collector.problem or found)
        config = RobotConfig.model_validate(collector.header["config"])
        source = EpisodeSource(path, file, collector, wanted)
        parts = [one for one in collector.parts if one.start == one.start]
        numbers = [number for number, one in enumerate(collector.parts) if one.start == one.start]
        if not parts:
            raise ConfigError(
                f"is damaged: holds no episode but {damages[0]}" if damages else "holds no episode"
            )
        kept = source.is_kept
        episodes = tuple(
            make_episode(one) if kept else source.make_lazy(number, one)
            for number, one in zip(numbers, parts, strict=True)
        )
        digest = hash_file(file, stream.at if cut is not None else None)
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
        text = f"{shorten_text(str(path))}: is damaged: {recording.describe_damage()}"
        warnings.warn(escape_unprintable(text), RecordingWarning, stacklevel=3)
    counts = {name: stream.counts[number] for number, name in names.items()}
    return recording, parts, {name: count for name, count in counts.items() if count}


def _collect(
    file: IO[bytes], collector: EpisodeCollector, names: dict[int, str]
) -> tuple[RecordStream, FileCut | None]:
    """Take all records of a file; keeps no more of them than fits into memory."""
    stream = RecordStream(file, collector.topics)
    try:
        for opcode, content in stream:
            collector.is_damaged = bool(stream.damages)
            _take(collector, names, opcode, content, stream.at)
            if collector.kept > KEPT_BYTES:
                collector.forget()
    except FileCut as cut:
        return stream, cut
    return stream, None


def _take(
    collector: EpisodeCollector, names: dict[int, str], opcode: int, content: bytes, at: int
) -> None:
    """Take a record, and note the names of channels."""
    if opcode == CHANNEL:
        channel = parse_record("Channel", content)
        names[channel.id] = channel.topic
    collector.take(opcode, content, at)


def hash_file(file: IO[bytes], end: int | None) -> str:
    """First 16 hex digits of the SHA-256 of a file, up to a place."""
    digest, place = hashlib.sha256(), 0
    file.seek(0)
    while block := file.read(DIGEST_BLOCK if end is None else min(DIGEST_BLOCK, end - place)):
        digest.update(block)
        place += len(block)
    return digest.hexdigest()[:16]


class RecordedEpisode(Episode):
    """An episode whose fields are read from the file when they are asked for."""

    _source: EpisodeSource
    _number: int

    def __getattr__(self, name: str) -> Any:
        """Read a field that isn't in memory."""
        group = GROUP_OF_FIELD.get(name)
        if group is None or "_source" not in self.__dict__:
            raise AttributeError(name)
        self._source.load(self, self._number, group)
        return self.__dict__[name]

    def __repr__(self) -> str:
        return f"<episode {self._number}, read when it is asked for>"

    def iterate_blocks(self) -> Iterator[Episode]:
        """Yield ticks, truth and wire in blocks."""
        return self._source.iterate_blocks(self._number)


class EpisodeSource:
    """A recording's file, from which episodes are read piece by piece.

    Attributes: `is_kept`, whether all of them are in memory.

    Args:
        path: of the file.
        file: the file itself, open.
        collector: what was found in it.
        wanted: topics that are wanted.
    """

    def __init__(
        self, path: Path, file: IO[bytes], collector: EpisodeCollector, wanted: Sequence[Topic]
    ) -> None:
        self.is_kept = collector.is_whole
        self._path = path
        self._identity = _identify_file(file)
        self._channels = dict(collector.topics)
        self._wanted = wanted
        self._parts: dict[int, EpisodeParts] = {}
        self._cached: OrderedDict[tuple[int, int], tuple[RecordedEpisode, int]] = OrderedDict()

    def make_lazy(self, number: int, parts: EpisodeParts) -> RecordedEpisode:
        """Make an episode that is read when it is asked for; `number` is that in the file."""
        parts.forget()
        self._parts[number] = parts
        episode = object.__new__(RecordedEpisode)
        for name, value in (describe_parts(parts) | {"_source": self, "_number": number}).items():
            object.__setattr__(episode, name, value)
        return episode

    def load(self, episode: RecordedEpisode, number: int, group: FieldGroup) -> None:
        """Read a group of fields; others are forgotten where there are too many."""
        size = self._size_of(number, group)
        while self._cached and size + sum(s for _, s in self._cached.values()) > CACHED_BYTES:
            (_, place), (other, _) = self._cached.popitem(last=False)
            for name in FIELD_GROUPS[place].fields:
                other.__dict__.pop(name, None)
        if REVOLUTIONS in group.topics and size > BLOCK_BYTES:
            fields = {"revolutions": self._list_revolutions(number)}
            size = 0
        else:
            fields = group.make(self._read_parts(number, group.topics))
        if group.fields == ("truth",):  # of which the tables aren't kept
            size = 24 * self._parts[number].counts[TICKS.name]
        for name, value in fields.items():
            object.__setattr__(episode, name, value)
        self._cached[number, FIELD_GROUPS.index(group)] = episode, size

    def _size_of(self, number: int, group: FieldGroup) -> int:
        """About how many bytes it takes to read a group of fields."""
        parts = self._parts[number]
        return sum(parts.sizes[t.name] + 24 * parts.counts[t.name] for t in group.topics)

    def _open_parts(self, number: int) -> EpisodeParts:
        """Parts of an episode without content."""
        known, parts = self._parts[number], EpisodeParts(None)
        parts.start, parts.offset, parts.info = known.start, known.offset, known.info
        parts.is_lost = False
        return parts

    def _read_parts(self, number: int, topics: Sequence[Topic]) -> EpisodeParts:
        """Read topics of an episode."""
        parts = self._open_parts(number)
        for _ in self._read_chunks(number, topics, parts, self._parts[number].places):
            pass
        return parts

    def _read_chunks(
        self,
        number: int,
        topics: Sequence[Topic],
        parts: EpisodeParts,
        places: Sequence[ChunkPlace],
    ) -> Iterator[ChunkPlace]:
        """Read topics of an episode chunk by chunk into `parts`."""
        topics = [topic for topic in topics if topic in self._wanted]
        with open_file(self._path, None) as file:
            if _identify_file(file) != self._identity:
                raise ConfigError("has changed since it was read: read it again")
            collector = EpisodeCollector()
            read_topics = (EPISODE, EXCHANGES, *topics)  # the first two tell episodes apart
            collector.topics = {n: t for n, t in self._channels.items() if t in read_topics}
            stream = RecordStream(file, collector.topics)
            for place in places:
                collector.begin_again(place, number, parts, topics)
                for opcode, content in stream.read_again(place.at):
                    if opcode == MESSAGE:
                        collector.take(opcode, content, place.at)
                yield place

    def iterate_blocks(self, number: int) -> Iterator[Episode]:
        """Yield ticks, truth and wire of an episode in blocks."""
        parts, carried = self._open_parts(number), np.zeros((0, len(EXCHANGES.columns)))
        topics, places = (TICKS, EXCHANGES, WIRE_SENT, WIRE_RECEIVED), self._parts[number].places
        fields = describe_parts(self._parts[number])
        for place in self._read_chunks(number, topics, parts, places):
            if sum(parts.sizes.values()) < BLOCK_BYTES and place is not places[-1]:
                continue
            exchanges = np.concatenate([carried, parts.table(EXCHANGES)])
            carried = exchanges[-CARRIED_ROWS:].copy()
            truth = join_truth(parts.table(TICKS), exchanges)
            made = make_ticks(parts) | make_wire(parts) | {"truth": truth}
            for group in FIELD_GROUPS:
                if "observations" in group.fields or "scans" in group.fields:
                    made |= group.make(parts)
            yield Episode(**fields | made)
            parts.forget()
            parts.sizes.clear()

    def _list_revolutions(self, number: int) -> Revolutions:
        """List the revolutions of an episode; what was measured is read when it is asked for."""
        heads: list[tuple[float, ...]] = []
        ends: list[int] = []
        parts, places = self._open_parts(number), self._parts[number].places
        for _ in self._read_chunks(number, (REVOLUTIONS,), parts, places):
            heads += (tuple(head.tolist()) for head, _ in _parse_revolutions(parts))
            ends.append(len(heads))
            parts.forget()
        rows = np.array(heads, np.float64).reshape(-1, 2)
        turns = StoredRevolutions(self, number, ends)
        return Revolutions(check_stamps(rows[:, 1]), turns, to_integers(rows[:, 0]))

    def read_revolutions(self, number: int, chunk: int) -> list[Floats]:
        """Read what was measured in the revolutions of one chunk of an episode."""
        parts, places = self._open_parts(number), self._parts[number].places[chunk : chunk + 1]
        for _ in self._read_chunks(number, (REVOLUTIONS,), parts, places):
            pass
        return [turn for _, turn in _parse_revolutions(parts)]


def _parse_revolutions(parts: EpisodeParts) -> Iterator[tuple[Floats, Floats]]:
    """Heads and measurements of the revolutions that were read."""
    buffer = parts.pieces(REVOLUTIONS)
    return map(parse_revolution, Pieces(buffer.data, buffer.ends))


def _identify_file(file: IO[bytes]) -> tuple[int, ...]:
    """What tells whether a file has changed."""
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


class StoredRevolutions(Sequence[Floats]):
    """What was measured in each revolution of a long episode, read chunk by chunk.

    Args:
        source: the file.
        number: of the episode.
        ends: how many revolutions there are up to the end of each chunk.
    """

    def __init__(self, source: EpisodeSource, number: int, ends: list[int]) -> None:
        self._source, self._number, self._ends = source, number, ends
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
            self._turns = self._source.read_revolutions(self._number, chunk)
            self._chunk = chunk
        return self._turns[number - (self._ends[chunk - 1] if chunk else 0)]


def iterate_blocks(episode: Episode) -> Iterator[Episode]:
    """Yield ticks, truth and wire of an episode in blocks of moderate size.

    Args:
        episode: of a recording.

    Yields:
        Parts of the episode, one after the other. Steps and scans are those of the whole episode
        where there is one part only, and else empty.
    """
    if isinstance(episode, RecordedEpisode):
        yield from episode.iterate_blocks()
    else:
        yield episode


def summarize(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON.

    Args:
        path: the recording.

    Raises:
        ConfigError: it can't be read.
    """
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


def summary_lines(found: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    about, robot, episodes = found["about"], found["robot"], found["episodes"]
    kind = "simulated" if robot["simulated"] else "real"
    whole = "whole" if found["whole"] else "cut: what followed is missing"
    if found["damage"]:
        whole = "damaged" if found["whole"] else f"damaged; {whole}"
    count = f"{len(episodes)} episode{'s' if len(episodes) != 1 else ''}"
    lost = "drops unknown"  # the end, which would tell them, is missing
    if found["dropped"] is not None:
        least = "" if found["whole"] else "at least "
        lost = f"{least}{found['dropped']:,} dropped" if found["dropped"] else "nothing dropped"
    lines = [
        f"{found['file']}: {whole}; {count}, {found['duration']:.1f} s, {lost}",
        f"{kind} robot, config {robot['sha256']}; file {found['sha256']}",
    ]
    if found["damage"]:
        lines.append(found["damage"])
    if about:
        lines.append(", ".join(f"{name} {_shorten(value)}" for name, value in about.items()))
    lines += [
        f"episode {number}: {one['duration']:.1f} s, {one['ticks']:,} ticks, "
        f"{one['steps']} steps, {one['scans']} scans; {_shorten(one['info'])}"
        for number, one in enumerate(episodes[:20])
    ]
    if len(episodes) > 20:
        lines.append(f"... and {len(episodes) - 20} more episodes")
    return lines + [f"{name:<20} {count:>9,}" for name, count in found["topics"].items()]


def _shorten(value: Any) -> str:
    """A value of the header on one line."""
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return shorten_text(text, 100)
