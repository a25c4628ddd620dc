"""The worst episodes of a benchmark, driven again so that they can be drawn."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.render import renderer
from acsar_gym.render.canvas import encode_png
from acsar_gym.tools.benchmark import plan as known
from acsar_gym.tools.benchmark.page.plots import Told
from acsar_gym.tools.benchmark.plan import BULLET, CONDITIONS, NOMINAL, PLANAR, Agent
from acsar_gym.tools.benchmark.scenes import SCENES
from acsar_gym.tools.benchmark.store import EpisodeRecord
from acsar_gym.tools.benchmark.store import episode_records as listed
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import pictures, report, runs
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.evaluation.page import Film


@dataclass(frozen=True, slots=True)
class Chosen:
    """An episode to be shown."""

    agent: str
    training_seed: int | None
    id: str
    link: str
    episode: EpisodeRecord


def films(
    results: Told, agents: Sequence[Agent] | None, count: int
) -> tuple[list[Film], list[str]]:
    """Drive the worst episodes again, and draw them.

    Args:
        results: content of `benchmark.json`.
        agents: see `report.write`.
        count: most episodes.

    Returns:
        The films, and why others are missing.

    Raises:
        MissingExtraError: moviepy isn't installed.
        ConfigError: there is no room for them on the disk.
    """
    some = chosen(results, count)
    if not some:
        return [], []
    renderer.import_moviepy()
    found, missing = [], []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episode.mp4"
        for each in report.watch_progress("drawing the worst episodes", some, len(some)):
            try:
                result = driven(each, _file(each, agents))
            except AcsarError as error:
                missing.append(f"{_title(each)}: {error}")
                continue
            found.append(film(_title(each), result, file))
    return found, missing


def chosen(results: Told, count: int) -> list[Chosen]:
    """Choose the worst nominal episodes of the best learned agent of each id.

    Failures come first, then the lowest scores; every id has about as many.
    """
    cells: dict[str, list[Chosen]] = {}
    for cell, agent in _cells(results):
        own = [
            Chosen(agent, cell["training_seed"], cell["id"], cell["link"], episode)
            for episode in listed(cell["episodes"])
        ]
        cells.setdefault(cell["id"], []).extend(own)
    queues = [sorted(some, key=_merit) for some in cells.values()]
    ranked = [
        each for place in range(count) for queue in queues for each in queue[place : place + 1]
    ]
    return sorted(ranked[:count], key=lambda each: (each.id, _merit(each)))


def _merit(each: Chosen) -> tuple[bool, float, float]:
    episode = each.episode
    return episode.success, episode.score, episode.soft_spl


def _cells(results: Told) -> Iterator[tuple[Told, str]]:
    """Yield the nominal cells of the best learned agent of each id, in PyBullet if it drove there.

    The best has the highest interquartile mean of the score.
    """
    rows = [
        row
        for row in results["rows"]
        if row["kind"] == known.LEARNED
        and not row["refused"]
        and (row["condition"], row["scenes"]) == (NOMINAL, "test")
        and row["link"] in (PLANAR, BULLET)
    ]
    best: dict[str, Told] = {}
    for row in sorted(rows, key=lambda row: (row["link"] == BULLET, row["score_iqm"])):
        best[row["id"]] = row
    for row in best.values():
        for cell in results["cells"]:
            if all(cell[name] == row[name] for name in _PLACE):
                yield cell, row["agent"]


_PLACE = ("agent", "id", "scenes", "link", "condition")


def _file(each: Chosen, agents: Sequence[Agent] | None) -> str:
    """Find the policy's file; ConfigError where it isn't known."""
    some = [*known.packaged_agents()] if agents is None else agents
    for agent in some:
        if (agent.name, agent.id, agent.training_seed) == (each.agent, each.id, each.training_seed):
            return agent.policy
    raise ConfigError("its policy isn't here")


def driven(each: Chosen, policy: str) -> EpisodeResult:
    """Drive an episode again, with a track.

    Args:
        each: the episode.
        policy: file or name of the policy.

    Raises:
        AcsarError: it can't be driven.
    """
    scenes, condition = SCENES[each.id].test, CONDITIONS[NOMINAL]
    seed, place = scenes.reset(scenes.numbers.index(each.episode.scene))
    loaded = runs.load_policy(policy, trust=False)
    options: dict[str, Any] = {"worlds": scenes.worlds, "tracked": True}
    with contextlib.closing(runs.make_env(loaded, each.link, condition.config, options)) as env:
        return next(evaluation.run_episodes(env, loaded, 1, seed, **place))


def film(title: str, result: EpisodeResult, file: Path) -> Film:
    """Draw an episode; `file` is overwritten with its video."""
    renderer.write_video(
        file, pictures.draw_frames(result), 1.0 / pictures.require_track(result).period
    )
    seconds = result.ended - result.started
    caption = f"{title}: {pictures.name_outcome(result)} after {seconds:.1f} s"
    return Film(caption, encode_png(pictures.draw_episode(result)), file.read_bytes())


def _title(each: Chosen) -> str:
    seed = "" if each.training_seed is None else f" {each.training_seed}"
    return f"{each.id}, {each.agent}{seed}, {each.link}, scene {each.episode.scene}"
