"""The command `acsar-gym policy`: show what a policy file says about itself."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, Any

import tyro

from acsar_gym.cli.options import Json


def show(
    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|NAME")],
    json: Json = None,
) -> int:
    """Print what a policy file says about itself: its task, robot, training and figures.

    Args:
        file: ONNX file, or the name of a packaged policy.
        json: also write all of it to this file.
    """
    from acsar_gym.evaluation import report  # noqa: PLC0415
    from acsar_gym.policies import showing  # noqa: PLC0415

    report.check_writable(json)
    path, bundle = showing.read(file)
    report.show(report.fact_table(str(path), showing.rows(bundle)))
    report.write_json(json, bundle.model_dump(mode="json"))
    return 0


POLICY: dict[str, Callable[..., Any]] = {"show": show}


def policy() -> int:
    """Show what a policy file says about itself: acsar-gym policy show FILE."""
    return int(
        tyro.extras.subcommand_cli_from_dict(POLICY, prog="acsar-gym policy", args=sys.argv[2:])
    )
