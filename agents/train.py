"""`acsar-gym train` as a script; its parts are in acsar_gym, its hyperparameters in recipes/.

python agents/train.py --env obstacle_goal --out runs/obstacle_goal
"""

from __future__ import annotations

import sys

from acsar_gym.tools import cli

if __name__ == "__main__":
    sys.argv = ["acsar-gym", "train", *sys.argv[1:]]
    cli.main()
