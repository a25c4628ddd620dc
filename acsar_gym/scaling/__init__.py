"""Runs independent jobs in this process, in several processes, or on a Ray cluster.

    for number, result in completed(function, jobs, workers=4): ...

Evaluations, the benchmark and trainings of several seeds all go through `completed`, so that each
runs on as many cores and machines as there are, with the same results.
"""

from acsar_gym.scaling.jobs import completed

__all__ = ["completed"]
