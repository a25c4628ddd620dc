"""How many of a kind a test looks at: a few in `make test`, many in `make test-slow`."""

from __future__ import annotations

import pytest


def samples(few: int, many: int) -> pytest.MarkDecorator:
    """Run a test with `count` = few, and where slow tests are wanted, with `count` = many."""
    return pytest.mark.parametrize("count", [few, pytest.param(many, marks=pytest.mark.slow)])
