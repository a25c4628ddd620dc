"""`acsar-gym` and `python -m acsar_gym`.

An emergency stop doesn't wait until the rest of the package is imported: it needs the standard
library alone.
"""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the command."""
    if sys.argv[1:] == ["estop"]:
        from acsar_gym.safety import estop  # noqa: PLC0415

        sys.exit(estop.command())
    from acsar_gym import cli  # noqa: PLC0415

    cli.main()


if __name__ == "__main__":
    main()
