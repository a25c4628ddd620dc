"""Licences of all that `pip install 'acsar_gym[all]'` installs, from what is installed here.

`make licences` writes docs/licences.md with this file.
"""

from __future__ import annotations

import re
import sys
from importlib import metadata
from typing import Any

from packaging.requirements import Requirement

PERMISSIVE = {
    *("0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause"),
    *("BSL-1.0", "CC0-1.0", "ISC", "MIT", "MIT-CMU", "PSF-2.0", "Zlib", "any-OSI"),
}
"""They ask for their notice in copies, and for little else."""
WEAK = {"LGPL-2.1-or-later", "MPL-2.0"}
"""Changes of these packages themselves must be published; what imports them is free."""
NOT_ASKED = {"all", "dev", "docs"}
"""Extras that no user of the package needs, and the sum of the others."""
CUDA = ("cuda-", "nvidia-", "triton")
"""Begin of the names of what torch's builds for NVIDIA's devices bring along."""
KNOWN = {
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD": "BSD-3-Clause",  # numba and pyserial
    "BSD License": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "GNU Lesser General Public License v2 or later (LGPLv2+)": "LGPL-2.1-or-later",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "zlib/libpng License": "Zlib",
}
"""Names that packages use for licences, and SPDX's."""
HEAD = """# Licences

`acsar_gym` is under the MIT licence. This table has all that `pip install 'acsar_gym[all]'`
installs on Linux, with the licences that the packages themselves name; `make licences` writes it,
and refuses others. All are permissive, but for those marked: their weak copyleft asks only that
changes of these packages themselves are published.

torch counts as its build for processors, which `constraints.txt` is for. Those for NVIDIA's devices
bring libraries under NVIDIA's own licences.

Some wheels carry programs of others. That of imageio-ffmpeg, which only the extras `train` and
`video` install, has an `ffmpeg` under the GPL, which runs as a process of its own. Those of numpy
and scipy have OpenBLAS (BSD-3-Clause) and GCC's runtime libraries (GPL-3.0 with the GCC runtime
exception, which allows any use).

| package | licence | installed by |
|---|---|---|
"""


def normal(name: str) -> str:
    """A package's name as PEP 503 compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def extras() -> list[str]:
    """The extras for users: not those for working on this package, and not their sum."""
    return sorted(set(metadata.metadata("acsar_gym").get_all("Provides-Extra") or []) - NOT_ASKED)


def _holds(one: Requirement, chosen: set[str]) -> bool:
    """Whether a requirement counts with these extras."""
    return one.marker is None or any(one.marker.evaluate({"extra": e}) for e in chosen | {""})


def installed_by(extra: str) -> set[str]:
    """What an extra installs, as far as it is installed here; "" is the base."""
    seen: set[tuple[str, frozenset[str]]] = set()
    todo = [("acsar-gym", frozenset({extra} - {""}))]
    while todo:
        asked = todo.pop()
        if asked in seen:
            continue
        try:
            lines = metadata.requires(asked[0]) or []
        except metadata.PackageNotFoundError:
            continue
        seen.add(asked)
        for line in lines:
            one = Requirement(line)
            if _holds(one, set(asked[1])):
                todo.append((normal(one.name), frozenset(one.extras)))
    return {name for name, _ in seen if not name.startswith(CUDA)} - {"acsar-gym"}


def licence(name: str) -> str:
    """A package's licence as an SPDX expression, as far as the package says it."""
    told: Any = metadata.metadata(name)  # a Message
    if "License-Expression" in told:
        return str(told["License-Expression"])
    kinds: list[str] = [kind.split(" :: ")[-1] for kind in told.get_all("Classifier") or []]
    own = str((told.get_all("License") or [""])[0])
    short = [own] if own and "\n" not in own else []
    named = [KNOWN.get(one, one) for one in short + kinds]
    known = [one for one in named if parts(one) <= PERMISSIVE | WEAK]
    return known[0] if known else own.partition("\n")[0]


def parts(expression: str) -> set[str]:
    """The licences of an SPDX expression."""
    return set(re.split(r" AND | OR ", expression))


def rows() -> dict[str, str]:
    """The table's rows, by package."""
    base, by = installed_by(""), {extra: installed_by(extra) for extra in extras()}
    found = {}
    for name in sorted(base.union(*by.values())):
        asked = "base" if name in base else ", ".join(e for e in by if name in by[e])
        mark = " (weak copyleft)" if parts(licence(name)) & WEAK else ""
        found[name] = f"| {name} | {licence(name)}{mark} | {asked} |"
    return found


if __name__ == "__main__":
    table = rows()
    other = [name for name in table if not parts(licence(name)) <= PERMISSIVE | WEAK]
    if other:
        sys.exit(f"make licences: neither permissive nor weak copyleft: {', '.join(other)}")
    print(HEAD + "\n".join(table.values()))
