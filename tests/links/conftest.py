"""A nursery of programs for each module that starts many."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from nursery import nursery as programs


@pytest.fixture(scope="module")
def nursery() -> Iterator[None]:
    """`nursery.program` works."""
    with programs():
        yield
