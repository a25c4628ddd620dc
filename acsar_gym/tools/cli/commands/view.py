"""The command `view`: a run in a browser."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import BagOptions, File, RobotArg, say

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|LINK")]


@command("view", "recordings")
def view_run(
    source: Source,
    bag: BagOptions,
    against: File = None,
    port: int = 8050,
    robot: RobotArg = None,
) -> int:
    """Show a run as a page in a browser, recorded or while it is driven; with a stop button.

    Args:
        source: a recording, also while it is being written, or a ROS 2 bag; or the device of a
            robot that a program on this computer drives with --record FILE.
        bag: of ROS 2.
        against: another recording that is drawn over it, such as the simulation of the same goals;
            episodes are paired by seed and goal.
        port: port of the page, on this computer only; 0 takes any free one.
        robot: ROS 2 bags: preset or file of the robot that it is of.
    """
    from acsar_gym.recording.bags import is_recording  # noqa: PLC0415
    from acsar_gym.tools.view.server import find_recording, serve_page  # noqa: PLC0415

    bag_or_file = Path(source)
    is_bag = bag_or_file.exists() and not is_recording(bag_or_file)
    path = bag.open(bag_or_file, robot) if is_bag else find_recording(source)
    if against is not None and path.exists():
        against = bag.open(against, robot)
    with serve_page(path, port, against) as server, contextlib.suppress(KeyboardInterrupt):
        say(f"{path}: open http://127.0.0.1:{server.port} in a browser; Ctrl-C ends it")
        server.serve_forever()
    return 0
