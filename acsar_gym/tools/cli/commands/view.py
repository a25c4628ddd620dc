"""The command `view`: a run in Rerun's viewer."""

from __future__ import annotations

import contextlib
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.errors import require_extra
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import BagOptions, File, Force, RobotArg, check_writable, say

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|LINK")]


@dataclass(frozen=True)
class ViewOptions:
    """What is shown, and where."""

    web: bool = False
    """Open it in a browser, at a page on this computer only, instead of a window."""
    port: int = 8050
    """Port of the page, whose data has the next one; 0 takes any free ones."""
    save: File = None
    """Write an .rrd file instead of opening a viewer."""
    force: Force = False


@command("view", "recordings")
def view_run(source: Source, bag: BagOptions, options: ViewOptions, robot: RobotArg = None) -> int:
    """Show a recorded run in Rerun's viewer.

    Args:
        source: a recording, or a ROS 2 bag.
        bag: of ROS 2.
        options: what is shown, and where.
        robot: ROS 2 bags: preset or file of the robot that it is of.
    """
    from acsar_gym.recording.bags import is_recording  # noqa: PLC0415

    os.environ.setdefault("RUST_LOG", "off")  # Rerun would tell that its viewer was closed
    with require_extra("the viewer", "view"):
        from acsar_gym.tools.view import show  # noqa: PLC0415

    check_writable(options.save, force=options.force, mark="RRF")
    bag_or_file = Path(source)
    is_readable = bag_or_file.is_file() or bag_or_file.is_dir()
    is_bag = is_readable and not is_recording(bag_or_file)
    path = bag.open(bag_or_file, robot) if is_bag else show.find_recording(source)
    if options.save is not None:
        count = show.save_recording(path, options.save)
        say(f"{options.save}: {count} episode{'s' * (count != 1)}, for Rerun's viewer")
        return 0
    port = options.port if options.web else None
    for number in (signal.SIGINT, signal.SIGTERM):  # Rerun's program ends with this one
        signal.signal(number, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        show.show_recording(path, port)
    return 0
