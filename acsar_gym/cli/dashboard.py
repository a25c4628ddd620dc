"""The command `view`: the dashboard."""

from __future__ import annotations

import contextlib
from typing import Annotated

import tyro

from acsar_gym.errors import printable

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|LINK")]


def view(source: Source, port: int = 8050) -> int:
    """Show a run as a page in a browser, recorded or while it is driven; with a stop button.

    Args:
        source: a recording, also while it is being written; or the device of a robot that a
            program on this computer drives with --record FILE.
        port: port of the page, on this computer only; 0 takes any free one.
    """
    from acsar_gym.dashboard.server import served  # noqa: PLC0415 - optional
    from acsar_gym.dashboard.source import recording_of  # noqa: PLC0415

    path = recording_of(source)
    with served(path, port) as server:
        print(
            printable(f"{path}: open http://127.0.0.1:{server.port} in a browser; Ctrl-C ends it"),
            flush=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
    return 0
