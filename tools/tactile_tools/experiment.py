"""``tactile experiment``: the paper's studies, repeated and judged."""

from __future__ import annotations

from tactile_tools.experiments.cli import add_parser

__all__ = ["add_parser"]
