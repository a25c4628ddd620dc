"""Puts the report together from the content of `benchmark.json`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import acsar_gym
from acsar_gym.tools.benchmark.page import plots, worst
from acsar_gym.tools.benchmark.page.plots import Told
from acsar_gym.tools.benchmark.plan import NOMINAL, Agent
from acsar_gym.tools.benchmark.table import LINK_NAMES, TABLE_COLUMNS, best_by_score
from acsar_gym.tools.evaluation.page import Film, Gallery, Grid, PageSection, Plot, ReportPage, Tile

WORST = 10
"""Episodes that are shown."""
INTRODUCTION = (
    "Every agent drives the same scenes with the same seeds. Intervals have 95 %: Wilson's for "
    "success, the stratified bootstrap over training seeds and scenes for the score's "
    "interquartile mean (IQM), as Agarwal et al. 2021 define them."
)
SCORE = (
    "The score of an episode is 0 without success, else the time of the shortest path at the "
    "robot's top speed over the time that it took; in PathFollow 1 - mean cross-track error / "
    "10 cm. Clearance, jerk and drift are means over episodes, time and energy over successful "
    "ones."
)


def write(
    results: Told, path: Path, agents: Sequence[Agent] | None = None, episodes: int = WORST
) -> None:
    """Write the report of a benchmark as one file.

    The worst episodes are driven again, to be drawn; that takes some seconds for each.

    Args:
        results: content of `benchmark.json`.
        path: HTML file to write.
        agents: the agents, with their files; None for the packaged ones and the baselines.
        episodes: most episodes to show; 0 drives none again.

    Raises:
        ConfigError: the file can't be written, as on a full disk.
        MissingExtraError: plotly isn't installed, or moviepy, where episodes are to be shown.
    """
    found, missing = worst.films(results, agents, episodes)
    page(results, found, missing).write(path)


def page(results: Told, films: Sequence[Film] = (), missing: Sequence[str] = ()) -> ReportPage:
    """Make the report.

    Args:
        results: content of `benchmark.json`.
        films: the worst episodes.
        missing: why episodes aren't shown.
    """
    rows = [row for row in results["rows"] if not row["refused"]]
    nominal = [row for row in rows if row["condition"] == NOMINAL]
    count = sum(row["episodes"] for row in rows)
    colors = plots.colors(rows)
    return ReportPage(
        title="Benchmark",
        subtitle=f"{len(colors)} agents, {count:,} episodes",
        said=[INTRODUCTION, SCORE, *_refused(results)],
        tiles=_tiles(results),
        sections=[
            *_places(results, nominal, colors),
            *_comparisons(results),
            *_robustness(results, rows, colors),
            *_worst(films),
            PageSection("Provenance", "", [_provenance(results["header"]), _policies(results)]),
        ],
        notes=missing,
        footer=f"acsar_gym {acsar_gym.__version__}",
    )


def _tiles(results: Told) -> list[Tile]:
    """Make a tile for the best learned agent of each id, behind the last of the links."""
    found: dict[str, Tile] = {}
    for best in results["best"]:
        if (best["figure"], best["scenes"]) == ("success_rate", "test"):
            label = f"{best['id']}, success, {best['learned']} : {best['baseline']}"
            value = f"{best['learned_value']:.1%} : {best['baseline_value']:.1%}"
            found[best["id"]] = Tile(label, value)
    return list(found.values())


def _refused(results: Told) -> list[str]:
    """Say which agents couldn't drive."""
    rows = [row for row in results["rows"] if row["refused"]]
    told = dict.fromkeys(f"{row['agent']} doesn't drive {row['id']}" for row in rows)
    return [f"{'; '.join(told)}."] if told else []


def _places(
    results: Told, nominal: Sequence[Told], colors: Mapping[str, str]
) -> Iterator[PageSection]:
    """Make a section for each id and set of scenes: table, scores and performance profile."""
    for env_id, scenes in dict.fromkeys((row["id"], row["scenes"]) for row in nominal):
        own = [row for row in nominal if (row["id"], row["scenes"]) == (env_id, scenes)]
        own.sort(key=lambda row: (list(LINK_NAMES).index(row["link"]), -row["score_iqm"]))
        parts: list[Grid | Plot] = [
            table(own),
            plots.scores(own, colors),
            plots.profiles(own, results, colors),
        ]
        name = env_id if scenes == "test" else f"{env_id}, {scenes} scenes"
        yield PageSection(name, _about(results["header"]["scenes"], env_id, scenes), parts)


def _about(scenes: Told, env_id: str, name: str) -> str:
    """Describe the scenes of an id."""
    about = scenes[env_id][name]
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"{about['count']} {kind}, {about['first']} to {last}, version {about['version']}, "
        f"sha256 {about['sha256'][:16]}."
    )


def table(rows: Sequence[Told]) -> Grid:
    """Make the table of some rows, without columns that have no value."""
    columns = {name: [_plain(cell(row)) for row in rows] for name, cell in TABLE_COLUMNS.items()}
    cut = [text.partition(", worst seed ") for text in columns["success"]]
    seeds = {"success": [rate for rate, _, _ in cut], "worst seed": [seed for _, _, seed in cut]}
    ordered = {
        key: cells
        for name, own in columns.items()
        for key, cells in (seeds if name == "success" else {name: own}).items()
    }
    told = {name: cells for name, cells in ordered.items() if any(cells)}
    lines = zip(*told.values(), strict=True)
    return Grid(list(told), [[text or "-" for text in line] for line in lines], 2)


def _plain(text: str) -> str:
    """Remove Markdown's marks from a cell."""
    return re.sub(r"^\*\*(.*)\*\*$", r"\1", text).replace("\\|", "|")


def _comparisons(results: Told) -> list[PageSection]:
    """Make the section of the probability of improvement."""
    own = best_by_score(results["best"])
    some = [
        each
        for each in results["improvements"]
        if (each["id"], each["scenes"], each["link"], each["agent"]) in own
    ]
    if not some:
        return []
    text = (
        "Probability that a run of the first agent scores more than one of the second in the same "
        "scene; equal scores count half. Right of the line the first agent is better."
    )
    return [PageSection("Probability of improvement", text, plots.improvements(some))]


def _robustness(
    results: Told, rows: Sequence[Told], colors: Mapping[str, str]
) -> list[PageSection]:
    """Make the section of the robustness profiles."""
    places = dict.fromkeys((row["id"], row["link"]) for row in rows if row["condition"] != NOMINAL)
    parts = [
        plots.robustness(
            [row for row in rows if (row["id"], row["link"]) == place and row["scenes"] == "test"],
            results["header"]["conditions"],
            colors,
        )
        for place in places
    ]
    text = "Success of each agent under conditions that differ from the nominal ones."
    return [PageSection("Robustness", text, parts)] if parts else []


def _worst(films: Sequence[Film]) -> list[PageSection]:
    """Make the section of the worst episodes."""
    text = (
        "Of the best learned agent of each id: failures first, then the lowest scores. Orange: the "
        "true path, blue: odometry, red: where it collided. A click plays the episode."
    )
    return [PageSection("Worst episodes", text, [Gallery(films)])] if films else []


def _provenance(header: Told) -> Grid:
    """Make the table of versions and scenes."""
    rows = [[name, version] for name, version in header["versions"].items()]
    for env_id, sets in header["scenes"].items():
        rows += [[f"{env_id} {name}", f"sha256 {about['sha256']}"] for name, about in sets.items()]
    return Grid(["what", "version"], rows, 2)


def _policies(results: Told) -> Grid:
    """Make the table of the learned policies' files."""
    rows = [
        [name, each["id"], _seed(each["training_seed"]), each["file"], each["sha256"] or "-"]
        for name, agent in results["header"]["agents"].items()
        for each in agent["policies"]
        if agent["kind"] == "learned"
    ]
    return Grid(["agent", "id", "training seed", "file", "sha256"], rows, 5)


def _seed(seed: int | None) -> str:
    return "-" if seed is None else str(seed)
