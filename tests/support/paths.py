"""Folders that tests read from, wherever the test itself lies."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
DATA = TESTS / "data"
"""Small recordings and files that come with the clone."""
SHARED = ROOT.parent / "shared"
"""Data beside the clone, on machines that have it; tests skip without."""
