from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tactiled.blocks import TaxelHealth
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings


@pytest.fixture
def flow(board, stream):
    """A stream into a pipeline without compensation and without the check for frozen taxels."""
    return stream(BoardPipeline(board(), PipelineSettings(method="off", frozen_after_s=None)))


FIELD = np.zeros((48, 3))


def test_cycle_is_complete_with_its_last_block(flow):
    assert flow.pipeline.feed(flow.block(2, FIELD)) == []
    assert flow.pipeline.feed(flow.block(0, FIELD)) == []
    (cycle,) = flow.pipeline.feed(flow.block(1, FIELD))
    assert cycle.sequence == 0
    assert cycle.force.shape == (48, 3)
    assert cycle.features.valid


def test_cycle_has_first_captured_and_last_received_instant(flow):
    blocks = [flow.block(a, FIELD) for a in range(3)]
    blocks[1] = dataclasses.replace(blocks[1], captured=-5, received=7_000_000, uncertainty=0.5)
    (cycle,) = [c for block in blocks for c in flow.pipeline.feed(block)]
    assert (cycle.captured, cycle.received, cycle.uncertainty) == (-5, 7_000_000, 0.5)


def test_next_sequence_ends_an_incomplete_cycle(flow):
    assert flow.cycle(FIELD, without=(1,)) == []
    incomplete, whole = flow.cycle(FIELD)
    assert (incomplete.sequence, whole.sequence) == (0, 1)
    assert (incomplete.health[16:32] == TaxelHealth.MISSING).all()
    assert (incomplete.health[:16] == 0).all()
    assert np.isnan(incomplete.force[16:32]).all()
    assert not incomplete.features.valid
    assert "array_missing:right" in incomplete.features.codes
    assert whole.features.valid
    counters = flow.pipeline.counters
    assert (counters.cycles, counters.incomplete_cycles, counters.missing_blocks) == (2, 1, 1)


def test_duplicates_and_late_blocks_are_counted_and_ignored(flow):
    first = flow.block(0, FIELD)
    flow.pipeline.feed(first)
    assert flow.pipeline.feed(first) == []
    assert flow.pipeline.counters.duplicate_blocks == 1
    flow.cycle(FIELD, without=(0,))
    assert flow.pipeline.feed(first) == []  # its cycle has been completed already
    assert flow.pipeline.counters.duplicate_blocks == 2
    (cycle,) = flow.cycle(FIELD)
    assert cycle.sequence == 1
    assert flow.pipeline.feed(first) == []
    flow.pipeline.feed(flow.block(0, FIELD))
    assert flow.pipeline.feed(first) == []
    assert flow.pipeline.counters.late_blocks == 2


def test_gaps_are_counted_exactly_across_the_wrap(flow):
    flow.sequence = 2**32 - 2
    for _ in range(4):
        flow.cycle(FIELD)
    assert flow.pipeline.counters.lost_cycles == 0
    assert flow.pipeline.counters.cycles == 4
    flow.sequence += 7
    (cycle,) = flow.cycle(FIELD)
    assert cycle.sequence == 9
    assert flow.pipeline.counters.lost_cycles == 7


def test_every_cycle_is_delivered_or_counted_lost(flow):
    rng = np.random.default_rng(4)
    sent, fed, out = 400, 0, []
    for _ in range(sent):
        without = tuple(a for a in range(3) if rng.random() < 0.2)
        fed += 3 - len(without)
        out += flow.cycle(FIELD, without=without)
    out += flow.pipeline.flush()
    counters = flow.pipeline.counters
    last = out[-1].sequence
    first = out[0].sequence
    assert counters.cycles == len(out)
    assert len(out) + counters.lost_cycles == last - first + 1
    assert 3 * len(out) - counters.missing_blocks == fed
    assert [c.sequence for c in out] == sorted({c.sequence for c in out})


def test_restarted_board_is_followed(flow):
    flow.sequence = 5000
    flow.cycle(FIELD)
    flow.sequence = 0
    flow.pipeline.reset()
    (cycle,) = flow.cycle(FIELD)
    assert cycle.sequence == 0
    assert flow.pipeline.counters.lost_cycles == 0


def test_unannounced_reboot_is_followed_after_a_few_blocks(flow):
    flow.sequence = 5000
    flow.cycle(FIELD)
    flow.sequence = 0
    out = [c for _ in range(6) for c in flow.cycle(FIELD)]
    assert out[-1].sequence == 5
    assert flow.pipeline.counters.restarts == 1
    assert flow.pipeline.counters.late_blocks == 7


def test_blocks_of_unknown_arrays_and_wrong_sizes_are_counted(flow):
    block = flow.block(0, FIELD)
    assert flow.pipeline.feed(dataclasses.replace(block, array=3)) == []
    assert flow.pipeline.feed(dataclasses.replace(block, array=255)) == []
    assert flow.pipeline.feed(dataclasses.replace(block, field_ut=np.zeros((5, 3)))) == []
    assert flow.pipeline.feed(dataclasses.replace(block, temperature_c=np.zeros(2))) == []
    counters = flow.pipeline.counters
    assert (counters.unknown_array, counters.wrong_shape) == (2, 2)


def test_feature_rate_marks_cycles_evenly(board, stream):
    flow = stream(
        BoardPipeline(
            board(), PipelineSettings(method="off", feature_rate_hz=15.0, frozen_after_s=None)
        )
    )
    due = [flow.one(FIELD).features_due for _ in range(200)]
    assert sum(due) == 30  # 15 Hz over 2 s of a 100 Hz stream
    gaps = np.diff(np.flatnonzero(due))
    assert set(gaps.tolist()) == {6, 7}


def test_the_same_blocks_give_the_same_cycles_to_the_bit(board, stream):
    def run():
        rng = np.random.default_rng(11)
        flow = stream(BoardPipeline(board(coupling=0.02), PipelineSettings()))
        out = []
        for k in range(60):
            field = rng.normal(0, 5, (48, 3))
            field[3:6, 2] += 200 * (k > 30)
            out += flow.cycle(field)
        return out

    for a, b in zip(run(), run(), strict=True):
        assert a.force.tobytes() == b.force.tobytes()
        assert a.ambient.plane.tobytes() == b.ambient.plane.tobytes()
        assert a.features.wrench.tobytes() == b.features.wrench.tobytes()
        assert a.features.reasons == b.features.reasons


@pytest.mark.parametrize(
    "wrong",
    [
        {"method": "magic"},
        {"compensation_rate_hz": 0.0},
        {"feature_rate_hz": -1.0},
        {"frozen_after_s": float("nan")},
        {"hold_s": float("inf")},
        {"tip_light_n": (2.0, 1.0)},
        {"release_ratio": 0.0},
    ],
)
def test_unusable_settings_are_refused_by_name(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        PipelineSettings(**wrong)
