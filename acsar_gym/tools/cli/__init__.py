"""The command line `acsar-gym`: parses arguments and calls the other packages.

Exit codes: 0 success, 1 a check or run failed, 2 bad argument, config or file, 3 link error, 130
interrupted.
"""

from acsar_gym.tools.cli.app import main
from acsar_gym.tools.cli.commands import COMMANDS

__all__ = ["COMMANDS", "main"]
