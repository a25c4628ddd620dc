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
Intervals have 95 %: Wilson's for success over all episodes, the stratified bootstrap over training
seeds and scenes for scores, as Agarwal et al. 2021 define it. The mean score counts every failure;
the interquartile mean (IQM) leaves out the worst and the best quarter. Differences are those to the
best baseline of the scenes, in pairs of episodes with the same scene and seed: intervals by the
paired bootstrap, p of success by McNemar's exact test (of several training seeds the least
significant one), p of the score by the bootstrap.

A failure scores 0. A success scores, as a set of scenes says: `completion_time`, the time of the
shortest path at the robot's top speed over the time that it took (Yokoyama et al. 2021);
`cross_track`, 1 - mean cross-track error / 10 cm; `barn_score`, that of BARN's contest with k = 2,
at most 0.5, whose reference speed is 2 m/s; `barn_score_own`, the same with the robot's own top
speed; or what the task tells under another name. Clearance, jerk and drift are means over episodes,
time and energy over successful ones.
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
        parts.append(f"## {env_id}, {scenes}\n\n{about}")
        if any(not row["refused"] for row in own):
            columns = agent_columns(own, told["paired"])
            learned = {row["agent"] for row in own if row["kind"] == "learned"}
            columns["agent"] = [f"**{n}**" if n in learned else n for n in columns["agent"]]
            parts.append(_format_table(list(columns), zip(*columns.values(), strict=True)))
        why = dict.fromkeys(_escape(row["refused"]) for row in own if row["refused"])
        if why:
            parts.append("\n".join(["Without a row:", "", *(f"- {said}" for said in why)]))
    parts += [_format_best(told), _format_improvements(told), _format_links(told["cells"])]
    parts += _format_profiles(rows, header["conditions"])
    return "\n".join(part.strip() + "\n" for part in parts if part)


def describe_scenes(about: Told) -> str:
    """Describe a set of scenes in a line."""
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"Robot {about['robot']}, score {about['score']}, {about['count']} {kind}, "
        f"{about['first']} to {last}, version {about['version']}, sha256 {about['sha256'][:16]}"
    )


PLACE = ("id", "scenes", "link")
"""What rows and their comparisons share."""


def agent_columns(rows: Sequence[Told], paired: Sequence[Told]) -> dict[str, list[str]]:
    """Return the columns of the table of some rows that have values; the best score first.

    Args:
        rows: of one set of scenes.
        paired: comparisons with the best baselines, of any place.
    """
    driven = [row for row in rows if not row["refused"]]
    driven.sort(key=lambda row: (list(LINK_NAMES).index(row["link"]), -row["score"]))
    found = {tuple(one[name] for name in (*PLACE, "agent", "figure")): one for one in paired}
    for number, row in enumerate(driven):
        own = [*(row[name] for name in (*PLACE, "agent"))]
        driven[number] = {**row, **{f"{f} over": found.get((*own, f)) for f in FIGURE_FORMATS}}
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


def _format_score(figure: str) -> Callable[[Told], str]:
    """Format a score with its interval."""

    def text(row: Told) -> str:
        low, high = row["intervals"][figure]
        return f"{row[figure]:.3f} ({low:.3f} to {high:.3f})"

    return text


def _format_difference(one: Told | None) -> str:
    """A paired difference, such as "+0.021 (+0.004 to +0.038) over dwa, p 0.012"."""
    if one is None:
        return ""
    (low, high), value, digits = one["interval"], one["difference"], 3
    if one["figure"] == "success":
        low, high, value, digits = 100.0 * low, 100.0 * high, 100.0 * value, 1
    p = "p < 0.001" if one["p"] < 0.001 else f"p {one['p']:.3f}"
    ends = f"{low:+.{digits}f} to {high:+.{digits}f}"
    unit = " points" if one["figure"] == "success" else ""
    return f"{value:+.{digits}f}{unit} ({ends}) over {escape_unprintable(one['over'])}, {p}"


TABLE_COLUMNS: dict[str, Callable[[Told], str]] = {
    "agent": lambda row: escape_unprintable(row["agent"]),
    "link": lambda row: LINK_NAMES[row["link"]],
    "seeds": lambda row: str(len(row["training_seeds"])) if row["kind"] == "learned" else "",
    "episodes": lambda row: str(row["episodes"]),
    "score": _format_score("score"),
    "success": _format_success,
    "score difference": lambda row: _format_difference(row["score over"]),
    "success difference": lambda row: _format_difference(row["success over"]),
    "score IQM": _format_score("score_iqm"),
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


FIGURE_FORMATS = {"score": ".3f", "success": ".1%"}
"""Formats of the figures that agents are compared by."""


def best_pairs(told: Told) -> list[Told]:
    """Return, by place and figure, the comparison of the best learned agent with the baseline."""
    found: dict[tuple[str, ...], Told] = {}
    for one in told["paired"]:
        place = tuple(one[name] for name in (*PLACE, "figure"))
        if one["kind"] == "learned" and (
            place not in found or one["values"][0] > found[place]["values"][0]
        ):
            found[place] = one
    return list(found.values())


def _format_best(told: Told) -> str:
    """The best learned agent against the best baseline."""
    rows = []
    for one in best_pairs(told):
        ours, other = (f"{value:{FIGURE_FORMATS[one['figure']]}}" for value in one["values"])
        where = one["id"], one["scenes"], LINK_NAMES[one["link"]], one["figure"]
        rows.append([*where, one["agent"], f"{ours} : {other}", _format_difference(one)])
    names = ["id", "scenes", "link", "figure", "learned", "values", "difference"]
    text = "Each figure has its own best agents; differences are those of the same episodes."
    return _format_section("Best learned agent against best baseline", text, names, rows)


def improvements_of_best(told: Told) -> list[Told]:
    """Return the probabilities of improvement of the learned agents with the highest scores."""
    own = {
        tuple(one[name] for name in (*PLACE, "agent"))
        for one in best_pairs(told)
        if one["figure"] == "score"
    }
    return [
        each
        for each in told["improvements"]
        if tuple(each[name] for name in (*PLACE, "agent")) in own
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
    driven = [row for row in rows if not row["refused"]]
    places = [tuple(row[name] for name in PLACE) for row in rows if row["condition"] != NOMINAL]
    for place in dict.fromkeys(places):
        own = [row for row in driven if tuple(row[name] for name in PLACE) == place]
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
        title = f"Robustness: {place[0]}, {place[1]}, {LINK_NAMES[place[2]]}"
        text = "Success (and its share of nominal)."
        yield _format_section(title, text, ["condition", *agents], lines)
