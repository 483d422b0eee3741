"""Folders that tests read from, independent of the test's place."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
DATA = TESTS / "data"
"""Small recordings and files in the repository."""
SHARED = ROOT.parent / "shared"
"""More data beside the clone, on machines that have it: whole recordings for `make recordings`."""
