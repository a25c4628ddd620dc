"""Writes the hashes of all generated scene sets to `scenes.json`, which takes some minutes.

For a change of the scenes that is wanted, see `acsar_gym.tools.benchmark.scenes`.
"""

from __future__ import annotations

import json
from typing import Any

from acsar_gym.tools.benchmark.scenes import (
    HASHES,
    PACKAGED_CHOICES,
    SCENES,
    SCENES_VERSION,
    find_sets,
    hash_scenes,
)

MAX_RECORDED = 100_000
"""Sets of more scenes aren't recorded, such as the seeds of a training on an open floor."""


def record_hashes() -> None:
    hashes: dict[str, Any] = {"version": SCENES_VERSION}
    splits = [scenes for by_split in SCENES.values() for scenes in by_split]
    driven = [scenes for env_id in PACKAGED_CHOICES for scenes in find_sets(env_id)]
    for scenes in (*splits, *driven):
        if len(scenes) <= MAX_RECORDED:
            hashes.setdefault(scenes.key, {})[scenes.split] = hash_scenes(scenes, len(scenes))
    HASHES.write_text(json.dumps(hashes, indent=1) + "\n")


if __name__ == "__main__":
    record_hashes()
