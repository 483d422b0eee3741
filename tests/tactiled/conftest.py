"""Scripted boards for the links, and real processes on a bus for the daemon."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh

from sensor_proto.packets import (
    Descriptor,
)
from tactile_core.bus.services import call
from tactile_core.bus.topics import service_key
from tactile_core.types import Instant
from tests.support.processes import Program
from tests.support.scripted_board import DESCRIPTOR, ScriptedBoard, at
from tests.support.tactiled_lab import FeatureListener, TactiledLab, tactiled_lab
from tests.support.waiting import PATIENCE_S


@pytest.fixture
def descriptor() -> Descriptor:
    return DESCRIPTOR


@pytest.fixture
def board() -> ScriptedBoard:
    return ScriptedBoard()


@pytest.fixture
def make_board() -> Callable[..., ScriptedBoard]:
    def make(serial: str = "00000000000000aa", **options: Any) -> ScriptedBoard:
        return ScriptedBoard(replace(DESCRIPTOR, unique_id=bytes.fromhex(serial)), **options)

    return make


@pytest.fixture
def instant() -> Callable[[float], Instant]:
    return at


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[TactiledLab]:
    with tactiled_lab(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TactiledLab, Program, Any]]:
    """A finger and an AnySkin board with one daemon, for tests that only query and listen."""
    with tactiled_lab(tmp_path_factory.mktemp("running")) as lab:
        lab.boards("--pty", "board0", "--seed", "1", link="board0")
        lab.boards("--pty", "skin0", "--board", "anyskin", "--seed", "2", link="skin0")
        lab.calibration("--seed", "1", "--out", "board0.cal.toml")
        daemon = lab.tactiled(
            "--port", "board0", "--name", "board0", "--port", "skin0", "--name", "skin0",
            "--calibration", "board0.cal.toml", "--log", "run.mcap",
        )  # fmt: skip
        session = lab.listen()
        FeatureListener(session).wait(20)
        yield lab, daemon, session


@pytest.fixture
def ask() -> Callable[..., Any]:
    """``ask(session, service)``: returns the answer of a board's service."""

    def question(
        session: zenoh.Session,
        service: str,
        payload: object = None,
        name: str = "board0",
        timeout: float = PATIENCE_S,
    ) -> Any:
        return call(session, service_key(name, service), payload, timeout)

    return question
