"""The parser of every command line."""

from __future__ import annotations

import argparse
import re
from typing import Any

NEGATIVE = re.compile(r"-(?:\.?\d|inf\b|nan\b)", re.IGNORECASE)
"""Begins a value with a minus, such as -0.25,0.1,0 or -30deg/10s, and never one of our flags."""


class Parser(argparse.ArgumentParser):
    """A parser that takes any value with a leading minus for a value, as people mean it.

    By itself argparse does so for plain numbers alone, and takes ``--home -0.25,0.1,0`` for a flag
    it does not know. Parsers of subcommands are of this kind, too.
    """

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        self._negative_number_matcher = NEGATIVE
