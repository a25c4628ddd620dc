"""Where a wheel is, by the name of its joint."""

from __future__ import annotations

import re

PLACE_WORDS = {
    word: place
    for place, words in {
        "l": "l left",
        "r": "r right",
        "f": "f front fore forward",
        "b": "b rear back hind aft",
        "fl": "fl lf",
        "fr": "fr rf",
        "bl": "rl bl lb lr",
        "br": "rr br rb",
    }.items()
    for word in words.split()
}
"""Where a wheel is, by the words of its joint's name."""
OTHER_WHEELS = re.compile(r"mid|middle|cent(er|re)|cast[eo]r|steer.*")
CORNERS = ("fr", "fl", "bl", "br")  # of the wheels a, b, c, d


def find_corner(name: str) -> str:
    """Where a wheel is by its joint's name: "fl", or "l" where it says no more; "" if nothing."""
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    if any(map(OTHER_WHEELS.fullmatch, words)):
        return ""
    places = [PLACE_WORDS[word] for word in words if word in PLACE_WORDS]
    joined = "".join(words)
    parts = re.findall("left|right|front|rear|back", joined)
    places += [PLACE_WORDS[part] for part in parts]
    corner = next((place for place in places if len(place) == 2), "")
    side = next((place for place in places if place in ("l", "r")), "")
    end = next((place for place in places if place in ("f", "b")), "")
    return corner or (end + side if side else "")
