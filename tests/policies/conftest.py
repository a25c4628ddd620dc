"""Torch on one thread: more of them wait for each other on a busy machine."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
