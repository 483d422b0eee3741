"""The live page: a skin, a reach or a log in any browser, served on this machine."""

from __future__ import annotations

from tactile_tools.view.cli import add_parser

__all__ = ["add_parser"]
