"""A policy of stable-baselines3, straight from its zip, drives the real robot. Safety first.

1. `acsar-gym doctor /dev/ttyUSB0 --spin` has found nothing that is wrong.
2. The first time the wheels are off the floor; then there is nothing within 1 m of its way.
3. `acsar-gym estop` is typed in a second terminal, ready for Enter; Ctrl-C stops it, too.

    python agents/examples/sb3_ppo.py    # leaves sb3.zip; a zip can run any code: use your own only
    python agents/examples/sb3_on_hardware.py sb3.zip --link /dev/ttyUSB0 --goal 1.0 0.3
"""

import sys
from pathlib import Path
from typing import Annotated

import gymnasium
import tyro
from stable_baselines3 import PPO

from acsar_gym import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.safety.rules import Reason, read_limits
from acsar_gym.tools.cli.options import countdown


def main(
    model: Annotated[Path, tyro.conf.Positional],
    link: str,
    goal: tuple[float, float] = (1.0, 0.0),
    robot: str = "acsar",
    speed: float = 0.2,
    seconds: float = 20.0,
    yes: bool = False,
) -> None:
    """Drive to a goal [m], no faster than `speed` [m/s]; `yes` leaves out the countdown."""
    config, most = RobotConfig.of(robot), max(abs(goal[0]), abs(goal[1])) + 0.5
    back, ahead, *_ = read_limits(config.linear_limits)
    slow = {"min_velocity": max(-speed, back), "max_velocity": min(speed, ahead)}
    fence = config.geofence or {"min_x": -most, "max_x": most, "min_y": -most, "max_y": most}
    config = config.with_(linear_limits=slow, geofence=fence)
    policy, name = PPO.load(model, device="cpu"), "acsar_gym:acsar_gym/PointGoal-v0"
    env = gymnasium.make(name, link=link, robot=config, max_episode_steps=round(10 * seconds))
    with env:  # which stops the wheels, whatever happens
        countdown(f"the robot on {link} will drive", yes=yes)
        (observation, info), over, reasons = env.reset(options={"goal": goal}), False, {"NONE"}
        while not over:
            action, _ = policy.predict(observation, deterministic=True)
            observation, _, ended, cut, info = env.step(action)
            over, reasons = ended or cut, reasons | {Reason(int(info["sent_reason"])).name}
    print(f"reached: {bool(info['is_success'])}, at {info['odom_x']:.2f}, {info['odom_y']:.2f} m")
    found = ", ".join(sorted(reasons - {"NONE"})) or "nothing"
    print(f"limited by {found}; {info.get('fault_reason', 'no fault')}")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except AcsarError as error:
        sys.exit(f"{error}")
