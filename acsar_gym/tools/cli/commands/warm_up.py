"""The command `warm-up`."""

from __future__ import annotations

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import EnvArg, RobotArg


@command("warm-up", "first steps")
def warm_up_caches(env: EnvArg = "", robot: RobotArg = None) -> int:
    """Compile all loops and generate the default worlds now, instead of at first use.

    Args:
        env: only for this env: point_goal, ..., or mine.module:mine/Task-v0.
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.tools import warm_up as warm  # noqa: PLC0415

    found = []
    for name in (env,) if env else warm.ENV_NAMES:
        print(f"{name}: ", end="", flush=True)
        found.append(done := warm.warm_env(name, robot))
        worlds = f", {done.worlds} worlds at hand" if done.worlds else ""
        print(f"{done.functions} functions compiled{worlds}, {done.seconds:.1f} s", flush=True)
    total, seconds = sum(done.functions for done in found), sum(done.seconds for done in found)
    print(f"ready in {seconds:.1f} s" + ("" if total else ": everything had been compiled before"))
    return 0
