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

`acsar_gym` is under the MIT licence. This table lists all that `pip install 'acsar_gym[all]'`
installs on Linux, with the licences that the packages declare, and torch as its build for
processors. `make licences` writes it, and refuses licences that aren't permissive or weak copyleft.
Weak copyleft requires only that changes of the packages themselves are published. The
extras that install such a package are in brackets.

Some wheels contain more. torch's builds for NVIDIA's devices install libraries under NVIDIA's own
licences. imageio-ffmpeg (extras `train` and `video`) has an `ffmpeg` under the GPL, which runs as a
process of its own. numpy and scipy have OpenBLAS (BSD-3-Clause) and GCC's runtime libraries
(GPL-3.0 with the GCC runtime exception, which allows any use).

| licence | packages |
|---|---|
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
    """The table's rows, by licence."""
    base = installed_by("")
    by_extra = {extra: installed_by(extra) for extra in extras()}
    packages: dict[str, list[str]] = {}
    for name in sorted(base.union(*by_extra.values())):
        spdx = licence(name)
        if parts(spdx) & WEAK:
            users = ["base"] if name in base else [e for e in by_extra if name in by_extra[e]]
            packages.setdefault(f"{spdx} (weak copyleft)", []).append(
                f"{name} ({', '.join(users)})"
            )
        else:
            packages.setdefault(spdx, []).append(name)

    return {spdx: f"| {spdx} | {', '.join(packages[spdx])} |" for spdx in sorted(packages)}


if __name__ == "__main__":
    table = rows()
    allowed = PERMISSIVE | WEAK
    other = [spdx for spdx in table if not parts(spdx.removesuffix(" (weak copyleft)")) <= allowed]
    if other:
        sys.exit(f"make licences: neither permissive nor weak copyleft: {', '.join(other)}")
    print(HEAD + "\n".join(table.values()))
