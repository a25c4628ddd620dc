"""`acsar-gym` and `python -m acsar_gym`.

An emergency stop doesn't wait until the rest of the package is imported.
"""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the command."""
    if sys.argv[1:2] == ["estop"]:
        from acsar_gym.safety import estop  # noqa: PLC0415

        code = estop.main(sys.argv[2:])
        if code is not None:
            sys.exit(code)
    from acsar_gym.tools import cli  # noqa: PLC0415

    cli.main()


if __name__ == "__main__":
    main()
