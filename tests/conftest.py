"""What all tests share: property tests draw the same examples every time, unless told otherwise."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from hypothesis import settings

# A red `make test` must be red again when it is looked into. `make test-random` draws new examples
# and prints how to get a failing one again.
settings.register_profile("same", derandomize=True, deadline=None, database=None)
settings.register_profile("random", deadline=None, database=None, print_blob=True)
settings.load_profile("same")


@pytest.fixture
def fresh_seed(request: pytest.FixtureRequest) -> int:
    """A seed: the same in ``make test``, another each time in ``make test-random``."""
    if request.config.getoption("--hypothesis-profile") != "random":
        return 0
    seed = random.SystemRandom().randrange(1 << 30)
    print("seed", seed)
    return seed


Edit = Callable[[str, int, Any], Iterable[tuple[str, int, Any]]]


def _when(row: tuple[Any, ...]) -> tuple[int, int]:
    return row[0], row[1]
