"""``tactile calibrate``: models of a board's own force, fitted to recordings and judged on them."""

from __future__ import annotations

from tactile_tools.calibrate.cli import add_parser

__all__ = ["add_parser"]
