"""The command `view`: a run in a browser."""

from __future__ import annotations

import contextlib
from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, say

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|LINK")]


@command("view", "recordings")
def view_run(source: Source, against: File = None, port: int = 8050) -> int:
    """Show a run as a page in a browser, recorded or while it is driven; with a stop button.

    Args:
        source: a recording, also while it is being written; or the device of a robot that a
            program on this computer drives with --record FILE.
        against: another recording that is drawn over it, such as the simulation of the same goals;
            episodes are paired by seed and goal.
        port: port of the page, on this computer only; 0 takes any free one.
    """
    from acsar_gym.tools.view.server import find_recording, serve_page  # noqa: PLC0415

    path = find_recording(source)
    with serve_page(path, port, against) as server, contextlib.suppress(KeyboardInterrupt):
        say(f"{path}: open http://127.0.0.1:{server.port} in a browser; Ctrl-C ends it")
        server.serve_forever()
    return 0
