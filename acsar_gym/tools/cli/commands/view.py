"""The command `view`: a recorded run in Rerun's viewer."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import Annotated

import tyro

from acsar_gym.errors import require_extra
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import BagOptions, File, RobotArg, check_writable, say

Recorded = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@command("view")
def view_run(source: Recorded, bag: BagOptions, save: File = None, robot: RobotArg = None) -> int:
    """Show a recorded run in Rerun's viewer. Drive with --view to watch a robot live.

    Args:
        source: A recording, or a ROS 2 bag.
        bag: Options of ROS 2 bags.
        save: Write an .rrd file instead of opening a viewer.
        robot: For ROS 2 bags: preset or file of the robot.
    """
    from acsar_gym.recording.bags import is_recording

    os.environ.setdefault("RUST_LOG", "off")  # Rerun would report that its viewer was closed
    with require_extra("the viewer", "view"):
        from acsar_gym.tools.view import show

    check_writable(save, mark="RRF")
    path = show.find_recording(source)
    if path.exists() and not is_recording(path):
        path = bag.open(path, robot)
    if save is not None:
        count = show.save_recording(path, save)
        say(f"{save}: {count} episode{'s' * (count != 1)}, for Rerun's viewer")
        return 0
    for number in (signal.SIGINT, signal.SIGTERM):  # Rerun's program ends with this one
        signal.signal(number, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        show.show_recording(path)
    return 0
