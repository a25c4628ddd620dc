"""Policies that nobody trained, from the textbooks: floors that a learned policy must beat.

`acsar-gym evaluate --policy dwa --env obstacle_goal`; docs/baselines.md describes each. Importing
this package imports none of them.
"""

BASELINES = {
    "random": "random_actions:RandomActions",
    "turn_drive": "turn_drive:TurnDrive",
    "smooth": "smooth:Smooth",
    "pure_pursuit": "pure_pursuit:PurePursuit",
    "stanley": "stanley:Stanley",
    "follow_gap": "follow_gap:FollowGap",
    "dwa": "dwa:Dwa",
    "mppi": "mppi:Mppi",
    "navfn": "navfn:Navfn",
}
"""What `--policy` calls each, and its module in this package and class."""
