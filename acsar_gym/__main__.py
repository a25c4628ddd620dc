"""`acsar-gym` and `python -m acsar_gym`. `ros2 run acsar_gym driver` and `... policy`.

An emergency stop doesn't wait until the rest of the package is imported.
"""

from __future__ import annotations

import sys

from acsar_gym.streams import open_streams, run_guarded


def main() -> None:
    """Entry point of the command."""
    open_streams()  # before anything else opens a file
    words = sys.argv[1:]
    if words[:1] == ["estop"] and not {"--help", "-h"} & {*words}:
        from acsar_gym.guard import estop  # noqa: PLC0415

        is_release = words[1:] == ["--release"]
        code = run_guarded(lambda: estop.run_command(release=is_release))
        # A wrong word is reported, but doesn't keep robots from being stopped.
        if is_release or not words[1:]:
            sys.exit(code)
    from acsar_gym.tools import cli  # noqa: PLC0415

    cli.main()


def ros_driver() -> None:
    """Entry point of the ROS package's `driver`, which is `acsar-gym ros driver`."""
    sys.argv[1:1] = ["ros", "driver"]
    main()


def ros_policy() -> None:
    """Entry point of the ROS package's `policy`, which is `acsar-gym ros policy`."""
    sys.argv[1:1] = ["ros", "policy"]
    main()


if __name__ == "__main__":
    main()
