"""Show what a policy file says about itself: acsar-gym policy show FILE."""

from __future__ import annotations

from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import ResultOptions, print_results


@command("policy show", "policies")
def show_policy(
    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|NAME")],
    output: ResultOptions,
) -> int:
    """Print what a policy file says about itself: its task, robot, training and figures.

    Args:
        file: ONNX file, or the name of a packaged policy.
        output: results in a file.
    """
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415
    from acsar_gym.tools.policies import OnnxPolicy, bundle  # noqa: PLC0415

    output.check()
    policy = OnnxPolicy(file)
    table = report.fact_table(str(policy.path), bundle.bundle_rows(policy.bundle))
    print_results(table, json=output.json, data=policy.bundle.model_dump(mode="json"))
    return 0
