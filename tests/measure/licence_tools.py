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
"""Changes of these packages themselves must be published. Programs that import them are free."""
NOT_FOR_USERS = {"all", "dev", "docs"}
"""Extras that no user of the package needs, and the sum of all extras."""
CUDA = ("cuda-", "nvidia-", "triton")
"""Starts of the names of what torch's builds for NVIDIA's devices install."""
SPDX = {
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
"""SPDX's names of licences that packages name in another way."""
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


def installed_by(extra: str) -> set[str]:
    """Packages that an extra installs, of those that are installed here. "" is the base."""
    visited: set[tuple[str, str]] = set()
    waiting = [("acsar-gym", extra)]
    while waiting:
        package, wanted = waiting.pop()
        if (package, wanted) in visited:
            continue
        try:
            lines = metadata.requires(package) or []
        except metadata.PackageNotFoundError:
            continue
        visited.add((package, wanted))

        for requirement in map(Requirement, lines):
            marker = requirement.marker
            if marker is None or marker.evaluate({"extra": wanted}):
                name = normal(requirement.name)
                waiting += [(name, needed) for needed in ("", *requirement.extras)]
    return {name for name, _ in visited if not name.startswith(CUDA)} - {"acsar-gym"}


def licence(name: str) -> str:
    """A package's licence as an SPDX expression, if the package names it."""
    message: Any = metadata.metadata(name)
    if "License-Expression" in message:
        return str(message["License-Expression"])
    field = str((message.get_all("License") or [""])[0])
    classifiers = [kind.split(" :: ")[-1] for kind in message.get_all("Classifier") or []]
    names = [SPDX.get(text, text) for text in (field, *classifiers)]
    accepted = (text for text in names if parts(text) <= PERMISSIVE | WEAK)
    return next(accepted, field.partition("\n")[0])


def parts(expression: str) -> set[str]:
    """The licences of an SPDX expression."""
    return set(re.split(r" AND | OR ", expression))


def rows() -> dict[str, str]:
    """The table's rows, by licence."""
    extras = set(metadata.metadata("acsar_gym").get_all("Provides-Extra") or []) - NOT_FOR_USERS
    by_extra = {extra: installed_by(extra) for extra in sorted(extras)}
    base = installed_by("")
    packages: dict[str, list[str]] = {}
    for name in sorted(base.union(*by_extra.values())):
        spdx = licence(name)
        if parts(spdx) & WEAK:
            users = ["base"] if name in base else [e for e in by_extra if name in by_extra[e]]
            spdx += " (weak copyleft)"
            name += f" ({', '.join(users)})"  # noqa: PLW2901
        packages.setdefault(spdx, []).append(name)
    return {spdx: f"| {spdx} | {', '.join(packages[spdx])} |" for spdx in sorted(packages)}


if __name__ == "__main__":
    table = rows()
    names = {spdx: spdx.removesuffix(" (weak copyleft)") for spdx in table}
    refused = [spdx for spdx, name in names.items() if not parts(name) <= PERMISSIVE | WEAK]
    if refused:
        sys.exit(f"make licences: neither permissive nor weak copyleft: {', '.join(refused)}")
    print(HEAD + "\n".join(table.values()))
