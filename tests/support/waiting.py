"""Wait for a condition with a generous deadline, instead of sleeping."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 180.0
"""Longest wait for anything, even on a busy machine, before a test gives up."""


def becomes_true(condition: Callable[[], object], timeout_s: float = PATIENCE_S) -> bool:
    """Return whether ``condition`` became true within ``timeout_s``."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() >= deadline:
            return bool(condition())
        time.sleep(0.005)
    return True


def wait_until(
    condition: Callable[[], object],
    timeout_s: float = PATIENCE_S,
    explain: Callable[[], object] = lambda: "condition never came true",
) -> None:
    """Wait until ``condition`` is true, or fail with the text of ``explain``."""
    assert becomes_true(condition, timeout_s), explain()
