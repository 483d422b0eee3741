"""Impossible readings, which the simulator adds to recordings and simulated boards."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest

from sim_device.board.anyskin import AnySkinBoard
from sim_device.board.catalogue import build_skin
from sim_device.board.recorded import ReplayBoard, load
from sim_device.faults import FaultPlan
from sim_device.skin.environment import Environment
from sim_device.skin.skin import Contact
from tactile_core.calibration.nominal import nominal
from tactile_core.types import Instant
from tactiled.blocks import Chunk, Cycle
from tactiled.boards.events import Sampled
from tactiled.boards.line import SerialLine
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings
from tactiled.sensing.reasons import Fault
from tests.support.paths import DATA, SHARED

WHOLE = SHARED / "data" / "eflesh"
FRAMES = int(os.environ.get("RECORDED_FRAMES", "600"))
"""Of each recording; `make recordings` takes all, and of whole recordings where they are beside."""
RECORDINGS = WHOLE if "RECORDED_FRAMES" in os.environ and WHOLE.is_dir() else DATA / "eflesh"
TICK_NS = 4_000_000


def cycles(board: AnySkinBoard | ReplayBoard, seconds: float, chips: int) -> Iterator[Cycle]:
    """Cycles that tactiled makes of the board's bytes, in virtual time."""
    line = SerialLine("virtual", lambda node, identity: None, "anyskin")
    pipeline = BoardPipeline(nominal("anyskin", "played", chips), PipelineSettings())
    line.connect(Instant(0))
    if isinstance(board, ReplayBoard):
        board.start(Instant(0))
    for tick in range(int(seconds * 1e9 / TICK_NS)):
        now = Instant(tick * TICK_NS)
        data = board.tick(now)
        if data:
            for event in line.receive(Chunk(now, data)):
                if isinstance(event.event, Sampled):
                    yield from pipeline.feed(event.event.block)


PLAYED = [
    ("zeros=skin:2@12s+4s", [2], {Fault.ZEROS, Fault.FROZEN}),
    ("zeros=skin:2:0.3@12s+4s", [2], {Fault.ZEROS}),
    ("zeros=skin:*:0.2@12s+4s", [0, 1, 2, 3, 4], {Fault.ZEROS}),
    ("ones=skin:1:0.3@12s+4s", [1], {Fault.ONES}),
    ("failed=skin:4@12s+4s", [4], {Fault.FAILED}),
    ("rail=skin:0@12s+4s", [0], {Fault.RAIL}),
    ("twin=skin:3@12s+4s", [3], {Fault.SAME_BITS, Fault.JUMPED}),
    ("dither=skin:3@12s", [3], {Fault.DITHER}),
    ("stuck=skin:3@12s", [3], {Fault.FROZEN}),
    ("hot=skin:2@12s+1s", [2], {Fault.TEMPERATURE_JUMP}),
    ("inf=skin:2@12s+4s", [2], {Fault.NOT_FINITE}),
    ("inf=skin:*:0.5@12s+4s", [0, 1, 2, 3, 4], {Fault.NOT_FINITE}),
    ("copy@12s+4s", [0, 1, 2, 3, 4], {Fault.COPY}),
]


def check(found: list[tuple[Cycle, bool]], chips: list[int], faults: set[Fault]) -> None:
    """Check that these chips are masked for these faults, and that no false force appears."""
    seen: set[int] = set()
    where: set[int] = set()
    for cycle, touched in found:
        where |= set(np.flatnonzero(cycle.fault).tolist())
        seen |= set(cycle.fault[cycle.fault > 0].tolist())
        if not touched:
            assert cycle.features.taxels_in_contact == 0
    assert where == set(chips) or (Fault.SAME_BITS in faults and where >= set(chips))
    assert seen & faults
    assert seen <= faults | {Fault.SAME_BITS, Fault.AXIS_STUCK, Fault.UNRESTED}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("faults", "chips", "codes"), PLAYED, ids=[p[0] for p in PLAYED])
def test_faults_on_an_untouched_simulated_board_are_masked(faults, chips, codes) -> None:
    plan = FaultPlan.parse("seed=3," + faults.replace("@12s", "@2s").replace("+4s", "+1.5s"))
    board = AnySkinBoard(build_skin("anyskin", 5), Environment(), plan=plan)
    check([(cycle, False) for cycle in cycles(board, 4.0, 5)], chips, codes)


# A count of this recording is too near its noise for a fault that dithers.
ON_RECORDED = [played for played in PLAYED if not played[0].startswith("dither")]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("faults", "chips", "codes"), ON_RECORDED, ids=[p[0] for p in ON_RECORDED])
def test_faults_on_a_pressed_recorded_board_are_masked(faults, chips, codes) -> None:
    recording = load(RECORDINGS / "shear_force_20250416_200533" / "sensor.csv.gz")
    count = recording.magnetometers
    names = chips if chips != [0, 1, 2, 3, 4] else list(range(count))
    board = ReplayBoard(recording, plan=FaultPlan.parse("seed=3," + faults))
    check([(cycle, True) for cycle in cycles(board, 17.0, count)], names, codes)


@pytest.mark.parametrize("name", sorted(p.name for p in RECORDINGS.glob("*_*")))
def test_recorded_boards_are_never_masked(name) -> None:
    recording = load(RECORDINGS / name / "sensor.csv.gz")
    chips = recording.magnetometers
    pipeline = BoardPipeline(nominal("anyskin", name, chips), PipelineSettings())
    board = ReplayBoard(recording)
    line = SerialLine("virtual", lambda node, identity: None, "anyskin")
    line.connect(Instant(0))
    board.start(Instant(0))
    count = 0
    times = recording.seconds.tolist()[:FRAMES]
    for seconds in times:
        now = Instant(round(seconds * 1e9) + 1000)
        for event in line.receive(Chunk(now, board.tick(now))):
            if isinstance(event.event, Sampled):
                for cycle in pipeline.feed(event.event.block):
                    assert not cycle.fault.any()
                    count += 1
    assert count > 0.9 * len(times)


@pytest.mark.parametrize(("rate", "presses"), [(14.0, 5), (115.0, 3), (900.0, 1)])
def test_simulated_presses_mask_nothing(rate, presses) -> None:
    """Twenty newtons within a tenth of a second, at one chip after the other, then gone."""
    skin = build_skin("anyskin", 7)
    array = skin.geometry.arrays[0]

    def contacts(seconds: float) -> list[Contact]:
        since = seconds - 1.0
        if since < 0:
            return []
        chip, phase = int(since) % 5, since % 1.0
        newton = 20.0 * min(1.0, phase / 0.1, max(0.0, (0.6 - phase) / 0.1))
        normal = array.rotation[chip] @ [0.0, 0.0, -newton]
        return [Contact(array.position[chip], normal, 3e-3)] if newton > 0 else []

    board = AnySkinBoard(skin, Environment(), contacts, loop_rate=rate, conversion_rate=rate)
    felt = 0
    for cycle in cycles(board, 1.0 + presses, 5):
        assert not cycle.fault.any()
        felt += cycle.features.taxels_in_contact > 0
    assert felt > 0.4 * presses * rate


def test_simulated_press_across_the_int16_wrap_is_read_correctly() -> None:
    skin = build_skin("anyskin", 7)
    array = skin.geometry.arrays[0]

    def contacts(seconds: float) -> list[Contact]:
        newton = 12.0 * min(1.0, max(0.0, (seconds - 2.0) / 0.5))
        normal = array.rotation[2] @ [0.0, 0.0, -newton]
        return [Contact(array.position[2], normal, 3e-3)] if newton > 0 else []

    last = []
    for faults in ("", "wrap=skin:2"):
        skin.reset()
        board = AnySkinBoard(skin, Environment(), contacts, FaultPlan.parse(faults))
        *_, cycle = cycles(board, 3.5, 5)
        last.append(cycle)
    plain, wrapped = last
    assert not wrapped.fault.any()
    assert wrapped.force[2, 2] == pytest.approx(plain.force[2, 2], rel=0.05)
