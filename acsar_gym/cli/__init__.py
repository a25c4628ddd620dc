"""`acsar-gym`: one command, subcommands, no logic.

Exit codes: 0 all well, 1 a check or run failed, 2 a bad argument, config or file, 3 the link, 130
interrupted.
"""

from acsar_gym.cli.app import COMMANDS, main

__all__ = ["COMMANDS", "main"]
