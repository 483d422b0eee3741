"""A lab without hardware: a fake arm, a fake board, and reachd itself as a process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from reachd.strategies.parameters import SETS
from support.reachd_lab import ReachdLab
from tactile_core.types import ArmLimits


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[ReachdLab]:
    made = ReachdLab(tmp_path)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def hardware_limits() -> ArmLimits:
    return replace(SETS["hardware"].safety.arm_limits)
