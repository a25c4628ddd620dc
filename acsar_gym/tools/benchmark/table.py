"""The tables of a benchmark in Markdown, from its JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from acsar_gym.errors import escape_unprintable
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
LINK_NAMES = {"planar": "planar", "bullet": "PyBullet", "port": "emulated port"}


def format_tables(told: Told) -> str:
    """Return the page.

    Args:
        told: as `store` describes `benchmark.json`.
    """
    parts = [TABLE_HEAD, _provenance(told["header"])]
    nominal = [row for row in told["rows"] if row["condition"] == NOMINAL]
    for env_id, scenes in _unique((row["id"], row["scenes"]) for row in told["rows"]):
        own = [row for row in nominal if (row["id"], row["scenes"]) == (env_id, scenes)]
        about = told["header"]["scenes"][env_id][scenes]
        parts.append(_heading(env_id, scenes, about))
        parts += [main_table(own)] if own else []
        parts += _refused(own)
    parts += _best(told["best"]) + _improvements(told) + _links(told)
    parts += _profiles(told["rows"], told["header"]["conditions"])
    return "\n".join(part.strip() + "\n" for part in parts if part)


def _unique(items: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """The different items, in order."""
    return list(dict.fromkeys(items))


def _provenance(header: Told) -> str:
    """Versions of what was used."""
    versions = ", ".join(f"{name} {version}" for name, version in header["versions"].items())
    return f"Versions: {versions}."


def _heading(env_id: str, scenes: str, about: Told) -> str:
    """Heading of an id's table, with its scenes."""
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"## {env_id}, {scenes} scenes\n\n{about['count']} {kind}, {about['first']} to {last}, "
        f"version {about['version']}, sha256 {about['sha256'][:16]}"
    )


def main_table(own: Sequence[Told]) -> str:
    """Return the table of some rows: by link, the best score first."""
    driven = [row for row in own if not row["refused"]]
    driven.sort(key=lambda row: (list(LINK_NAMES).index(row["link"]), -row["score_iqm"]))
    shown = {
        name: cells
        for name, cell in TABLE_COLUMNS.items()
        if any(cells := [cell(row) for row in driven])
    }
    rows = zip(*shown.values(), strict=True)
    return _table(list(shown), [[cell or "-" for cell in row] for row in rows])


def _table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; numbers are aligned to the right."""
    aligned = ["---" if number == 0 else "---:" for number in range(len(names))]
    lines = [names, aligned, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _refused(own: Sequence[Told]) -> list[str]:
    """Why agents have no row."""
    why = dict.fromkeys(_plain(row["refused"]) for row in own if row["refused"])
    return ["\n".join(["Without a row:", "", *(f"- {said}" for said in why)])] if why else []


def _plain(text: str) -> str:
    """Escape what has a meaning in a table."""
    return escape_unprintable(text).replace("|", "\\|")


def _number(key: str, digits: int, factor: float = 1.0) -> Callable[[Told], str]:
    """Format a figure; empty where there is none."""
    return lambda row: "" if row.get(key) is None else f"{row[key] * factor:.{digits}f}"


def _success(row: Told) -> str:
    """Success rate with its interval [%], and the seeds' worst and median where there are some."""
    low, high = row["success_interval"]
    told = f"{row['success_rate']:.1%} ({100 * low:.1f} to {100 * high:.1f})"
    if len(row["training_seeds"]) > 1:
        worst, median = row["success_worst_seed"], row["success_median_seed"]
        told += f", worst seed {worst:.1%}, median {median:.1%}"
    return told


def _score(row: Told) -> str:
    low, high = row["intervals"]["score_iqm"]
    return f"{row['score_iqm']:.3f} ({low:.3f} to {high:.3f})"


TABLE_COLUMNS: dict[str, Callable[[Told], str]] = {
    "agent": lambda row: (
        f"**{_plain(row['agent'])}**" if row["kind"] == "learned" else _plain(row["agent"])
    ),
    "link": lambda row: LINK_NAMES[row["link"]],
    "seeds": lambda row: str(len(row["training_seeds"])) if row["kind"] == "learned" else "",
    "episodes": lambda row: str(row["episodes"]),
    "success": _success,
    "score IQM": _score,
    "SPL": _number("spl", 3),
    "BARN score, own speed": _number("barn_score_own", 3),
    "BARN score, 2 m/s": _number("barn_score", 3),
    "cross-track [cm]": _number("cross_track", 2, 100.0),
    "time [s]": _number("time_to_goal", 2),
    "clearance [cm]": _number("clearance", 1, 100.0),
    "turning [rad/m]": _number("smoothness", 2),
    "jerk [m/s³]": _number("jerk", 2),
    "energy [J]": _number("energy", 2),
    "drift [%]": _number("odometry_drift", 2, 100.0),
}
"""Cells of the main tables; empty text means no value, and columns without any are left out."""


def _best(best: Sequence[Told]) -> list[str]:
    """The best learned agent against the best baseline."""
    if not best:
        return []
    rows = [list(map(_plain, _best_row(each))) for each in best]
    names = ["id", "scenes", "link", "figure", "learned", "baseline", "values", "better"]
    text = (
        "## Best learned agent against best baseline\n\nEach figure has its own best agents. Their "
        "intervals are the stratified bootstrap's, over scenes and training seeds."
    )
    return [f"{text}\n\n{_table([*names, 'intervals apart'], rows)}"]


FIGURE_FORMATS = {"success_rate": ("success", ".1%"), "score_iqm": ("score IQM", ".3f")}
"""Title and format of the figures that the best are compared by."""


def _best_row(each: Told) -> list[str]:
    """Cells of one comparison."""
    title, form = FIGURE_FORMATS[each["figure"]]
    return [
        *(each["id"], each["scenes"], LINK_NAMES[each["link"]], title),
        *(each["learned"], each["baseline"]),
        f"{each['learned_value']:{form}} : {each['baseline_value']:{form}}",
        *("yes" if each[name] else "no" for name in ("better", "apart")),
    ]


def best_by_score(best: Sequence[Told]) -> set[tuple[str, str, str, str]]:
    """Id, scenes, link and name of the learned agents with the highest scores."""
    return {
        (each["id"], each["scenes"], each["link"], each["learned"])
        for each in best
        if each["figure"] == "score_iqm"
    }


def _improvements(told: Told) -> list[str]:
    """Probability of improvement of the best learned agents."""
    own = best_by_score(told["best"])
    rows = [
        [
            *(each["id"], each["scenes"], LINK_NAMES[each["link"]]),
            *(_plain(each["agent"]), _plain(each["over"])),
            f"{each['probability']:.3f} ({each['interval'][0]:.3f} to {each['interval'][1]:.3f})",
        ]
        for each in told["improvements"]
        if (each["id"], each["scenes"], each["link"], each["agent"]) in own
    ]
    if not rows:
        return []
    text = (
        "## Probability of improvement\n\nThat a run of the first agent scores more than one of "
        "the second in the same scene; equal scores count half."
    )
    return [f"{text}\n\n{_table(['id', 'scenes', 'link', 'agent', 'over', 'probability'], rows)}"]


def _links(told: Told) -> list[str]:
    """Success of the same agents behind different links, in the scenes that all these drove."""
    drives: dict[tuple[str, str, str], dict[str, dict[Any, bool]]] = {}
    for cell in told["cells"]:
        if cell["condition"] == NOMINAL and not cell["refused"]:
            place = cell["id"], cell["scenes"], cell["agent"]
            own = drives.setdefault(place, {}).setdefault(cell["link"], {})
            driven = cell["episodes"]
            for scene, success in zip(driven["scene"], driven["success"], strict=True):
                own[cell["training_seed"], scene] = success
    names = [link for link in LINK_NAMES if any(link in own for own in drives.values())]
    rows = [
        [*map(_plain, place), *_common(own, names)] for place, own in drives.items() if len(own) > 1
    ]
    if not rows:
        return []
    head = ["id", "scenes", "agent", "episodes", *(LINK_NAMES[name] for name in names)]
    text = "## The same agents behind other links\n\nSuccess in the scenes that all of them drove."
    return [f"{text}\n\n{_table(head, rows)}"]


def _common(drives: Mapping[str, Mapping[Any, bool]], names: Sequence[str]) -> list[str]:
    """Number of the scenes that all links drove, and the share of successes behind each link."""
    shared = set.intersection(*map(set, drives.values()))
    rates = {
        link: f"{sum(own[each] for each in shared) / len(shared):.1%}"
        for link, own in drives.items()
        if shared
    }
    return [str(len(shared)), *(rates.get(name, "-") for name in names)]


def _profiles(rows: Sequence[Told], conditions: Told) -> list[str]:
    """Success under every condition, and relative to nominal."""
    found = []
    for place in _unique((row["id"], row["link"]) for row in rows if row["condition"] != NOMINAL):
        own = [row for row in rows if (row["id"], row["link"]) == place and not row["refused"]]
        own = [row for row in own if row["scenes"] == "test"]
        rates = {(row["agent"], row["condition"]): row["success_rate"] for row in own}
        agents = list(dict.fromkeys(row["agent"] for row in own))
        lines = [
            [conditions[name]["words"], *(_relative(rates, agent, name) for agent in agents)]
            for name in conditions
        ]
        head = (
            f"## Robustness: {place[0]}, {LINK_NAMES[place[1]]}\n\nSuccess (and its share of "
            "nominal)."
        )
        found.append(f"{head}\n\n{_table(['condition', *map(_plain, agents)], lines)}")
    return found


def _relative(rates: Mapping[tuple[str, str], float], agent: str, condition: str) -> str:
    """Success under a condition, and its share of that under nominal conditions."""
    rate, nominal = rates.get((agent, condition)), rates.get((agent, NOMINAL))
    if rate is None:
        return "-"
    return f"{rate:.1%}" + (f" ({rate / nominal:.3f})" if nominal and condition != NOMINAL else "")
