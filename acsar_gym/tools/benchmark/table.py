"""The tables of a benchmark in Markdown, from its JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from acsar_gym.errors import escape_unprintable
from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools.benchmark.plan import NOMINAL

Told = Mapping[str, Any]
TABLE_HEAD = """# Benchmark

`acsar-gym benchmark` writes this page. Every agent drives the same scenes with the same seeds.
Intervals have 95 %: Wilson's for success over all episodes; for the score the stratified bootstrap
over training seeds and scenes of its interquartile mean (IQM), as Agarwal et al. 2021 define them.
The score of an episode is 0 without success, else the time of the shortest path at the robot's top
speed over the time that it took (success weighted by completion time, Yokoyama et al. 2021); in
PathFollow 1 - mean cross-track error / 10 cm. BARN scores have k = 2. Clearance, jerk and drift are
means over episodes, time and energy over successful ones.
"""
LINK_NAMES = {name: body.title for name, body in BODIES.items()} | {"port": "emulated port"}


def format_tables(told: Told) -> str:
    """Return the page.

    Args:
        told: as `store` describes `benchmark.json`.
    """
    header, rows = told["header"], told["rows"]
    versions = ", ".join(f"{name} {version}" for name, version in header["versions"].items())
    parts = [TABLE_HEAD, f"Versions: {versions}."]
    for env_id, scenes in dict.fromkeys((row["id"], row["scenes"]) for row in rows):
        own = [
            row
            for row in rows
            if (row["id"], row["scenes"], row["condition"]) == (env_id, scenes, NOMINAL)
        ]
        about = describe_scenes(header["scenes"][env_id][scenes])
        parts.append(f"## {env_id}, {scenes} scenes\n\n{about}")
        if own:
            columns = agent_columns(own)
            learned = {row["agent"] for row in own if row["kind"] == "learned"}
            columns["agent"] = [f"**{n}**" if n in learned else n for n in columns["agent"]]
            parts.append(_format_table(list(columns), zip(*columns.values(), strict=True)))
        why = dict.fromkeys(_escape(row["refused"]) for row in own if row["refused"])
        if why:
            parts.append("\n".join(["Without a row:", "", *(f"- {said}" for said in why)]))
    parts += [_format_best(told["best"]), _format_improvements(told), _format_links(told["cells"])]
    parts += _format_profiles(rows, header["conditions"])
    return "\n".join(part.strip() + "\n" for part in parts if part)


def describe_scenes(about: Told) -> str:
    """Describe a set of scenes in a line."""
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"{about['count']} {kind}, {about['first']} to {last}, version {about['version']}, sha256 "
        f"{about['sha256'][:16]}"
    )


def agent_columns(rows: Sequence[Told]) -> dict[str, list[str]]:
    """Return the columns of the table of some rows that have values; the best score first."""
    driven = [row for row in rows if not row["refused"]]
    driven.sort(key=lambda row: (list(LINK_NAMES).index(row["link"]), -row["score_iqm"]))
    columns = {name: [cell(row) for row in driven] for name, cell in TABLE_COLUMNS.items()}
    return {name: [cell or "-" for cell in cells] for name, cells in columns.items() if any(cells)}


def _format_table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; numbers are aligned to the right."""
    aligned = ["---" if number == 0 else "---:" for number in range(len(names))]
    lines = [map(_escape, line) for line in (names, aligned, *rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _format_section(
    title: str, text: str, names: Sequence[str], rows: Sequence[Sequence[str]]
) -> str:
    """A heading, a paragraph and a table; empty where there are no rows."""
    return f"## {title}\n\n{text}\n\n{_format_table(names, rows)}" if rows else ""


def _escape(text: str) -> str:
    """Escape what has a meaning in a table."""
    return escape_unprintable(text).replace("|", "\\|")


def _format_number(key: str, digits: int, factor: float = 1.0) -> Callable[[Told], str]:
    """Format a figure; empty where there is none."""
    return lambda row: "" if row.get(key) is None else f"{row[key] * factor:.{digits}f}"


def _format_success(row: Told) -> str:
    """Success rate with its interval [%], and the seeds' worst and median where there are some."""
    low, high = row["success_interval"]
    told = f"{row['success_rate']:.1%} ({100 * low:.1f} to {100 * high:.1f})"
    if len(row["training_seeds"]) > 1:
        worst, median = row["success_worst_seed"], row["success_median_seed"]
        told += f", worst seed {worst:.1%}, median {median:.1%}"
    return told


def _format_score(row: Told) -> str:
    low, high = row["intervals"]["score_iqm"]
    return f"{row['score_iqm']:.3f} ({low:.3f} to {high:.3f})"


TABLE_COLUMNS: dict[str, Callable[[Told], str]] = {
    "agent": lambda row: escape_unprintable(row["agent"]),
    "link": lambda row: LINK_NAMES[row["link"]],
    "seeds": lambda row: str(len(row["training_seeds"])) if row["kind"] == "learned" else "",
    "episodes": lambda row: str(row["episodes"]),
    "success": _format_success,
    "score IQM": _format_score,
    "SPL": _format_number("spl", 3),
    "BARN score, own speed": _format_number("barn_score_own", 3),
    "BARN score, 2 m/s": _format_number("barn_score", 3),
    "cross-track [cm]": _format_number("cross_track", 2, 100.0),
    "time [s]": _format_number("time_to_goal", 2),
    "clearance [cm]": _format_number("clearance", 1, 100.0),
    "turning [rad/m]": _format_number("smoothness", 2),
    "jerk [m/s³]": _format_number("jerk", 2),
    "energy [J]": _format_number("energy", 2),
    "drift [%]": _format_number("odometry_drift", 2, 100.0),
}
"""Cells of the main tables; empty text means no value, and columns without any are left out."""


FIGURE_FORMATS = {"success_rate": ("success", ".1%"), "score_iqm": ("score IQM", ".3f")}
"""Title and format of the figures that the best are compared by."""


def _format_best(best: Sequence[Told]) -> str:
    """The best learned agent against the best baseline."""
    rows = []
    for each in best:
        title, form = FIGURE_FORMATS[each["figure"]]
        rows.append(
            [
                *(each["id"], each["scenes"], LINK_NAMES[each["link"]], title),
                *(each["learned"], each["baseline"]),
                f"{each['learned_value']:{form}} : {each['baseline_value']:{form}}",
                *("yes" if each[name] else "no" for name in ("better", "apart")),
            ]
        )
    names = ["id", "scenes", "link", "figure", "learned", "baseline", "values", "better"]
    text = (
        "Each figure has its own best agents. Their intervals are the stratified bootstrap's, over "
        "scenes and training seeds."
    )
    title = "Best learned agent against best baseline"
    return _format_section(title, text, [*names, "intervals apart"], rows)


def improvements_of_best(told: Told) -> list[Told]:
    """Return the probabilities of improvement of the learned agents with the highest scores."""
    own = {
        (each["id"], each["scenes"], each["link"], each["learned"])
        for each in told["best"]
        if each["figure"] == "score_iqm"
    }
    return [
        each
        for each in told["improvements"]
        if (each["id"], each["scenes"], each["link"], each["agent"]) in own
    ]


def _format_improvements(told: Told) -> str:
    rows = [
        [
            *(each["id"], each["scenes"], LINK_NAMES[each["link"]], each["agent"], each["over"]),
            f"{each['probability']:.3f} ({each['interval'][0]:.3f} to {each['interval'][1]:.3f})",
        ]
        for each in improvements_of_best(told)
    ]
    text = (
        "That a run of the first agent scores more than one of the second in the same scene; equal "
        "scores count half."
    )
    names = ["id", "scenes", "link", "agent", "over", "probability"]
    return _format_section("Probability of improvement", text, names, rows)


def _format_links(cells: Sequence[Told]) -> str:
    """Success of the same agents behind different links, in the scenes that all these drove."""
    drives: dict[tuple[str, str, str], dict[str, dict[Any, bool]]] = {}
    for cell in cells:
        if cell["condition"] == NOMINAL and not cell["refused"]:
            place = cell["id"], cell["scenes"], cell["agent"]
            own = drives.setdefault(place, {}).setdefault(cell["link"], {})
            driven = cell["episodes"]
            for scene, success in zip(driven["scene"], driven["success"], strict=True):
                own[cell["training_seed"], scene] = success
    names = [link for link in LINK_NAMES if any(link in own for own in drives.values())]
    rows = []
    for place, links in drives.items():
        if len(links) > 1:
            shared = set.intersection(*map(set, links.values()))
            rates = {
                link: f"{sum(won[each] for each in shared) / len(shared):.1%}"
                for link, won in links.items()
                if shared
            }
            shares = [rates.get(name, "-") for name in names]
            rows.append([*place, str(len(shared)), *shares])
    head = ["id", "scenes", "agent", "episodes", *(LINK_NAMES[name] for name in names)]
    text = "Success in the scenes that all of them drove."
    return _format_section("The same agents behind other links", text, head, rows)


def _format_profiles(rows: Sequence[Told], conditions: Told) -> Iterator[str]:
    """Success under every condition, and relative to nominal."""
    driven = [row for row in rows if row["scenes"] == "test" and not row["refused"]]
    places = dict.fromkeys((row["id"], row["link"]) for row in rows if row["condition"] != NOMINAL)
    for place in places:
        own = [row for row in driven if (row["id"], row["link"]) == place]
        rates = {(row["agent"], row["condition"]): row["success_rate"] for row in own}
        agents = list(dict.fromkeys(row["agent"] for row in own))
        lines = []
        for name in conditions:
            cells = []
            for agent in agents:
                rate, nominal = rates.get((agent, name)), rates.get((agent, NOMINAL))
                cell = "-" if rate is None else f"{rate:.1%}"
                if rate is not None and nominal and name != NOMINAL:
                    cell += f" ({rate / nominal:.3f})"
                cells.append(cell)
            lines.append([conditions[name]["words"], *cells])
        title = f"Robustness: {place[0]}, {LINK_NAMES[place[1]]}"
        text = "Success (and its share of nominal)."
        yield _format_section(title, text, ["condition", *agents], lines)
