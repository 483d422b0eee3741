"""Models recover skins whose creep, hysteresis and delay are known, and run the same anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_core.calibration import loads, nominal, saves
from tactile_core.types import NS_PER_S, Instant
from tactile_tools.calibrate.assemble import board
from tactile_tools.calibrate.evaluate import predict, tail20
from tactile_tools.calibrate.fit import Choice, choose, fit, folds
from tactile_tools.calibrate.label_clock import find_clock
from tactile_tools.calibrate.readouts import export, pipeline
from tactile_tools.calibrate.recipes import FORCE_RECIPES, PLACE_RECIPES, Recipe, feature_map
from tactile_tools.calibrate.recording import RecordingError
from tactile_tools.calibrate.rows import align, causal, copies
from tactile_tools.calibrate.splits import block_edges, block_masks
from tactiled.blocks import SampleBlock
from tactiled.sensing.forces import NetEstimator, batch_features, readout
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings

LINEAR, CUBIC, CREEP, PLAY = FORCE_RECIPES


def elastic(time, depth):
    return 10 * depth + 4 * depth**2


def creeping(time, depth):
    """A spring beside a Maxwell element of 5 s."""
    held, state = np.zeros_like(depth), 0.0
    for i in range(1, len(time)):
        state += (depth[i] - state) * -np.expm1(-(time[i] - time[i - 1]) / 5.0)
        held[i] = depth[i] - state
    return np.maximum(10 * depth + 6 * held, 0)


def dragging(time, depth):
    """A spring beside a slider that yields after 0.3 of depth, on the way in and on the way out."""
    back, state = np.zeros_like(depth), 0.0
    for i, each in enumerate(depth):
        state = min(max(state, each - 0.3), each + 0.3)
        back[i] = each - state
    return np.maximum(12 * depth + 5 * np.maximum(back, -depth), 0)


@pytest.mark.parametrize(("force", "recipe"), [(creeping, CREEP), (dragging, PLAY)])
def test_model_with_history_fits_hysteresis(make_recording, force, recipe):
    recording = make_recording(force, seconds=120)
    recipe = replace(recipe, penalties=(1.0,))
    simple = tail20([recording], [CUBIC])[0].rmse[0]
    with_history = tail20([recording], [recipe])[0].rmse[0]
    assert simple > 0.25  # what the rubber adds when loaded and takes when unloaded
    assert with_history < simple / 3


def test_model_kind_is_chosen_by_the_skin(make_recording):
    choice = choose([make_recording(creeping, seconds=80)], [LINEAR, CUBIC, CREEP])
    assert choice.recipe is CREEP
    assert {s.recipe.name for s in choice.scores} == {"linear", "cubic", "creep"}


def test_too_short_recording_is_refused_with_a_remedy(make_recording):
    with pytest.raises(RecordingError, match=r"labels over 5 s.*record more presses"):
        choose([make_recording(elastic, seconds=6, period=3)], [LINEAR])


def test_label_delay_is_estimated(make_recording):
    """A slow memory alone: one of 0.3 s would explain part of the delay."""
    recording = make_recording(lambda time, depth: 10 * depth, delay=0.25, seconds=120, period=10)
    slow = replace(CREEP, components=2, degree=1, taus_s=(10.0,), lagged=1, lag_degree=0)
    choice = choose([recording], [replace(slow, penalties=(0.01,))])
    assert choice.delay_s == pytest.approx(0.25, abs=0.051)


def test_load_cell_beat_is_estimated(make_recording):
    """Readings 0.2 s apart, fetched every 0.205 s: one in forty is skipped."""
    time = np.arange(0.0, 400.0, 0.205)
    true = np.floor(time / 0.2) * 0.2
    dense = np.arange(0.0, 401.0, 0.01)
    label = np.interp(true, dense, elastic(dense, np.clip(np.sin(2 * np.pi * dense / 20), 0, None)))
    clock = find_clock(time, label)
    assert clock is not None
    assert clock.reading_s == pytest.approx(0.2, rel=1e-3)
    assert clock.beat_s == pytest.approx(0.2 * 0.205 / 0.005, rel=0.01)
    wrong = np.abs(clock.lag_s - (time - true))
    moving = np.abs(np.gradient(label, time)) > 0.5  # a tooth cannot be seen where nothing moves
    assert np.median(wrong[moving]) < 0.02
    assert np.median(clock.lag_s) > 0.05


def test_no_false_beat_is_found(make_recording):
    recording = make_recording(creeping)
    assert find_clock(recording.label_time_s, recording.labels[:, 0]) is None


@settings(max_examples=40, deadline=None)
@given(
    gaps=st.lists(st.floats(0.01, 2.0), min_size=60, max_size=150),
    fold=st.integers(0, 4),
    gap=st.floats(0.0, 5.0),
)
def test_folds_leave_gaps_and_test_every_row_once(gaps, fold, gap):
    time = np.cumsum(gaps)
    edges = block_edges(time)
    for begin_end in edges:
        fit_on, test = block_masks(time, begin_end, gap)
        assert test.any()
        apart = np.abs(time[fit_on][:, None] - time[test][None])
        assert apart.size == 0 or apart.min() >= gap
    tested = sum(block_masks(time, e, gap)[1].astype(int) for e in edges)
    assert (tested == 1).all()


def test_test_rows_are_never_near_training_rows(make_recording):
    recordings = [make_recording(elastic, seconds=90, seed=s, name=str(s)) for s in (0, 1)]
    made = copies(feature_map(CREEP, recordings), recordings, restarts=True)
    rows = align(made, recordings, 0.1)
    assert len(made) > 2  # begun anew in the pauses
    seen = 0
    for fit_on, test in folds(rows, recordings):
        assert test.any()
        assert fit_on.any()
        for number in np.unique(rows.recording[test]):
            mine = fit_on & (rows.recording == number)
            if mine.any():
                near = np.searchsorted(np.sort(rows.time_s[mine]), rows.time_s[test])
                times = np.concatenate([[-np.inf], np.sort(rows.time_s[mine]), [np.inf]])
                assert min((rows.time_s[test] - times[near]).min(), 9e9) >= 3.0
        seen += 1
    assert seen == 12  # five blocks of each, and each as a whole


def test_model_features_are_causal(make_recording):
    recording = make_recording(creeping, seconds=60)
    features = feature_map(PLAY, [recording])
    whole = batch_features(features, recording.time_s, recording.change_ut())
    half = len(recording.time_s) // 2
    changed = recording.change_ut()
    changed[half:] += 1000.0
    again = batch_features(features, recording.time_s, changed)
    assert np.array_equal(whole[:half], again[:half])
    frames, values = np.arange(5.0), np.arange(5.0)[:, None] * 10
    assert causal(frames, values, np.array([2.5]), 0.0)[0, 0] == 20  # not 25: frame 3 comes later
    assert causal(frames, values, np.array([3.0]), 0.5)[0, 0] == 25


@pytest.mark.parametrize(
    "recipe",
    [
        LINEAR,
        PLAY,
        PLACE_RECIPES[-1],
        replace(CREEP, readout="mlp", units=12, penalties=(0.01,)),
    ],
    ids=lambda r: f"{r.name}-{r.readout}",
)
def test_saved_model_matches_scikit_learn(make_recording, recipe: Recipe):
    recording = make_recording(creeping, seconds=60)
    features = feature_map(recipe, [recording])
    rows = align(copies(features, [recording], recipe.restarts), [recording], 0.0)
    fitted = pipeline(recipe, recipe.penalties[0], len(rows.labels))
    fitted.fit(rows.features, rows.labels)
    model = fit([recording], Choice(recipe, recipe.penalties[0], 0.0, (), ()))
    assert export(fitted)[2][0].kind == model.layers[0].kind
    calibration = board(nominal("anyskin", "s", 5), [recording], [model], "s")
    kept = loads(saves(calibration))
    assert kept.hash == calibration.hash
    unbounded = replace(kept.nets[0], floor=np.array([-np.inf]))
    expected = fitted.predict(rows.features).reshape(-1, 1)
    assert readout(unbounded, rows.features) == pytest.approx(expected, abs=1e-6)


def test_frame_by_frame_equals_batch(make_recording):
    recording = make_recording(dragging, seconds=60)
    model = fit([recording], Choice(PLAY, 1.0, 0.0, (), ()))
    change = recording.change_ut()
    whole = readout(model, batch_features(model.features, recording.time_s, change))
    estimator = NetEstimator(model)
    steps = np.diff(recording.time_s, prepend=recording.time_s[0])
    one_by_one = [estimator.step(f, s) for f, s in zip(change, steps.tolist(), strict=True)]
    assert np.array(one_by_one) == pytest.approx(whole, abs=1e-9)


def test_daemon_pipeline_matches_batch(make_recording):
    """Chips turned, the file's own rest field, tared at the start: features add up to the model."""
    recording = make_recording(creeping, seconds=60)
    model = fit([recording], Choice(CREEP, 1.0, 0.0, (), ()))
    calibration = board(nominal("anyskin", "s", 5), [recording], [model], "s")
    line = BoardPipeline(calibration, PipelineSettings(method="off", frozen_after_s=None))
    yaw = calibration.arrays[0].geometry.chip_yaw
    cycles = []
    for i, (time, field) in enumerate(zip(recording.time_s, recording.field_ut, strict=True)):
        x, y, z = field.reshape(5, 3).T
        chips = np.column_stack(
            [np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z]
        )
        now = Instant(round(time * NS_PER_S) + NS_PER_S)
        block = SampleBlock(0, i, now, now, 1e-3, chips, np.array([25.0]), np.zeros(5, np.uint8))
        cycles += line.feed(block)
    first = next(i for i, c in enumerate(cycles) if np.isfinite(c.force).all())
    assert 0 < first < 20  # a tare of half a second
    count = first - 0
    tared = recording.field_ut - recording.field_ut[:count].mean(axis=0)
    batch = readout(model, batch_features(model.features, recording.time_s[first:], tared[first:]))[
        :, 0
    ]
    live = np.array([-c.force[:, 2].sum() for c in cycles[first:]])
    assert live == pytest.approx(batch, abs=1e-6)
    felt = np.array([c.features.normal_force for c in cycles[first:]])
    pressed = batch > 2.0
    assert felt[pressed] == pytest.approx(batch[pressed], rel=0.02)
    truth = np.interp(recording.time_s[first:], recording.label_time_s, recording.labels[:, 0])
    assert np.sqrt(((live - truth) ** 2).mean()) < 0.35
    assert predict(model, recording).shape == recording.labels.shape


def test_forces_are_invalid_while_a_taxel_is_masked(make_recording):
    recording = make_recording(elastic, seconds=60)
    model = fit([recording], Choice(CREEP, 1.0, 0.0, (), ()))
    calibration = board(nominal("anyskin", "s", 5), [recording], [model], "s")
    line = BoardPipeline(calibration, PipelineSettings(method="off", auto_tare=False))
    reasons = set()
    for i in range(4):
        now = Instant((i + 1) * NS_PER_S // 10)
        status = np.array([0, 0, 0, 0, 4 if i == 3 else 0], np.uint8)
        block = SampleBlock(
            0, i, now, now, 1e-3, recording.field_ut[i].reshape(5, 3), np.array([25.0]), status
        )
        for cycle in line.feed(block):
            reasons |= set(cycle.features.codes)
            assert np.isnan(cycle.force[4]).all() == (i == 3)
    assert "model_paused" in reasons
