"""Texts of a picture are inside it and off its data; what a log lacks is not drawn."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

from tactile_tools.plot import curves, skin
from tactile_tools.plot.curves import broken, holes, presses
from tactile_tools.plot.look import LOOKS, Sheet, styled
from tactile_tools.plot.series import BoardSeries, Track, read_boards
from tests.support import virtual_daemon

SHEETS: dict[str, Callable[..., Sheet]] = {
    "overview": skin.overview_sheet,
    "taxels": skin.taxels_sheet,
    "forces": curves.forces_sheet,
    "field": curves.field_sheet,
    "timing": curves.timing_sheet,
}
REASON = "the ambient field is not known: fewer than half of the taxels of the left side agree"


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> BoardSeries:
    """A simulated finger that is pressed on its left side from 1.5 s on."""
    path = tmp_path_factory.mktemp("skin") / "run.mcap"
    daemon = virtual_daemon.VirtualDaemon(
        path,
        [virtual_daemon.make_board(contacts=virtual_daemon.press, rate=50.0)],
        [virtual_daemon.calibration()],
    )
    daemon.run(2.2)
    daemon.close()
    return read_boards(path)["finger"]


def with_events(board: BoardSeries, count: int) -> BoardSeries:
    """The same with ``count`` events, texts of all lengths and invalid stretches."""
    rng = np.random.default_rng(count)
    when = np.sort(rng.uniform(board.first, board.last, count)).tolist()
    events = [(t, f"event_{i} of $x$\n" + "and so on " * (i % 9)) for i, t in enumerate(when)]
    events += [(1e6, "by another clock")] if count else []
    return dataclasses.replace(board, events=events, events_left_out=count // 10)


def with_hole(board: BoardSeries, begin: float, end: float) -> BoardSeries:
    """The same without anything between two moments, s."""

    def cut(track: Track) -> Track:
        kept = Track()
        for time, item in zip(track.time, track.items, strict=True):
            if not begin < time < end:
                kept.add(time, item)
        return kept

    tracks = [name for name in vars(board) if isinstance(getattr(board, name), Track)]
    return dataclasses.replace(board, **{name: cut(getattr(board, name)) for name in tracks})


def laid_out(sheet: Sheet) -> Any:
    """Return the figure; fail where a text is outside it, on its data or on other text."""
    figure = sheet.finish()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a layout that does not fit warns
        figure.canvas.draw()
    whole, inches = figure.bbox, figure.get_tightbbox()
    assert inches.x0 * figure.dpi >= -1
    assert inches.y0 * figure.dpi >= -1
    assert inches.x1 * figure.dpi <= whole.x1 + 1
    assert inches.y1 * figure.dpi <= whole.y1 + 1
    legends = [a.get_legend() for a in figure.axes if a.get_legend()] + list(figure.legends)
    titles = [a.title for a in figure.axes if a.title.get_text()]
    said = [artist.get_window_extent().padded(-1) for artist in (*legends, *titles)]
    labels = [label for a in figure.axes for label in (a.xaxis.label, a.yaxis.label)]
    said += [label.get_window_extent().padded(-1) for label in labels if label.get_text()]
    said.append(figure._suptitle.get_window_extent().padded(-1))
    for one, other in itertools.combinations(said, 2):
        assert not one.overlaps(other)
    for box, axes in itertools.product(said, figure.axes):
        if axes.axison:
            assert not box.overlaps(axes.get_window_extent().padded(-1))
    for axes in figure.axes:
        boxes = [t.get_window_extent().padded(-0.5) for t in axes.texts if t.get_text()]
        for one, other in itertools.combinations(boxes, 2):
            assert not one.overlaps(other), [t.get_text() for t in axes.texts]
    return figure


@pytest.mark.parametrize(
    ("size", "count"), [("screen", 0), ("column", 4), ("page", 200), ("column", 200)]
)
def test_event_labels_never_cover_the_data(board: BoardSeries, size: str, count: int) -> None:
    look = LOOKS[size]
    with styled(look):
        figure = laid_out(curves.forces_sheet(with_events(board, count), look))
        texts = [t.get_text() for axes in figure.axes for t in axes.texts]
    listed = [text for text in texts if " s: event_" in text]
    assert min(count, 3) <= len(listed) <= min(count, curves.LISTED)
    if count == 4:
        assert any("event_0 of $x$\\n" in text for text in listed)
        assert any("by another clock" in text for text in texts)
    if count == 200:
        assert any("more, which `tactile log cat` lists" in text for text in texts)


@pytest.mark.parametrize("what", SHEETS)
@pytest.mark.parametrize("size", ["column", "screen"])
def test_labels_stay_inside_every_picture_and_off_the_data(
    board: BoardSeries, what: str, size: str
) -> None:
    """Also with long and odd names, a hole and invalid features."""
    names = ["_left $x$", "the right side of the finger, seen from the wrist", "tip"]
    geometry = SimpleNamespace(
        **{name: getattr(board.geometry, name) for name in (
            "array_side", "array_rows", "array_columns", "surface", "position", "model")},
        array_name=names,
    )  # fmt: skip
    odd = dataclasses.replace(with_hole(board, 0.8, 1.2), name="_a_$b$_c", geometry=geometry)
    held = [(features, features.valid, features.reasons) for features in odd.features[5:20]]
    for features, _, _ in held:
        features.valid, features.reasons = False, [REASON, "taring", "another_reason"]
    look = LOOKS[size]
    try:
        with styled(look):
            figure = laid_out(SHEETS[what](odd, look=look))
    finally:
        for features, valid, reasons in held:
            features.valid, features.reasons = valid, reasons
    assert "_a_$b$_c" in figure._suptitle.get_text()
    keys = " ".join(t.get_text() for legend in figure.legends for t in legend.texts)
    assert "nothing in the log: a hole of 0.4" in keys
    if what != "timing":
        assert "features not valid: the ambient" in keys
        named = [t.get_text() for a in figure.axes if a.get_legend() for t in a.get_legend().texts]
        assert any(text.strip("\u200a ").endswith("_left $x$") for text in named)


def test_no_line_is_drawn_across_missing_data(board: BoardSeries) -> None:
    look = LOOKS["screen"]
    with styled(look):
        for build in (curves.forces_sheet, curves.field_sheet, curves.timing_sheet):
            figure = build(with_hole(board, 0.8, 1.2), look).figure
            drawn_lines = 0
            for axes in figure.axes:
                for line in axes.lines:
                    x, y = (np.asarray(v, float) for v in line.get_data())
                    whole = np.isfinite(x) & np.isfinite(y)
                    if len(x) > 50 and whole.any():
                        drawn_lines += 1
                        steps = np.diff(x)[whole[1:] & whole[:-1]]
                        assert steps.max() < 0.15
            assert drawn_lines >= 3


def test_no_circle_is_cut_off_or_lies_on_the_key(board: BoardSeries) -> None:
    """Whichever taxels bear the greatest force that a picture shows."""
    pressed = Track()
    for time, force in zip(board.time, board.force, strict=True):
        pressed.add(time, np.full_like(force, -skin.LARGEST))
    look, maps = LOOKS["screen"], 0
    with styled(look):
        figure = skin.taxels_sheet(
            dataclasses.replace(board, force_track=pressed), look=look
        ).figure
    for axes in figure.axes:
        circles = [each for each in axes.collections if isinstance(each, EllipseCollection)]
        if circles:
            drawn, key = circles
            radius = np.asarray(drawn.get_widths())[:, None] / 2
            least, most = drawn.get_offsets() - radius, drawn.get_offsets() + radius
            (left, right), (_, top) = axes.get_xlim(), axes.get_ylim()
            above_key = key.get_offsets()[0][1] + key.get_widths()[0] / 2
            assert left <= least[:, 0].min() + 1e-9
            assert most[:, 0].max() <= right + 1e-9
            assert above_key <= least[:, 1].min()
            assert most[:, 1].max() <= top + 1e-9
            maps += 1
    assert maps >= 3


def test_missing_data_is_distinguished_from_delay_and_rate_change() -> None:
    time = np.arange(0.0, 10.0, 0.01)
    assert holes(time) == []
    late = time + np.where(np.arange(len(time)) % 97 == 0, 0.03, 0.0)
    assert holes(late) == []
    (one,) = holes(time[(time < 3) | (time > 3.2)])
    assert one == pytest.approx((2.99, 3.21), abs=0.011)
    slower = np.concatenate([time, 10.0 + np.arange(0.0, 20.0, 0.2), 30.0 + time])
    assert holes(slower) == []
    assert len(holes(np.concatenate([time, [40.0], 50.0 + time]))) == 2
    assert holes(time[:3]) == holes([]) == []
    x, y = broken(time[(time < 3) | (time > 3.2)], np.ones(((time < 3) | (time > 3.2)).sum()))
    assert np.isnan(y).sum() == 1
    assert 3.0 < x[np.isnan(y)][0] < 3.2


def test_strongest_moments_are_different_presses() -> None:
    """A jam that chatters is one press; a press held while another comes and goes is another."""
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 20.0, 0.01)
    left = np.where((time > 2) & (time < 8), rng.uniform(0, 14, len(time)), 0.0)
    left[(time > 12) & (time < 13)] = 3.0
    right = np.where((time > 5) & (time < 6), 6.0, 0.0)
    right += np.where((time > 15) & (time < 16.5), 2.0 + 0.1 * rng.normal(size=len(time)), 0.0)
    found = [float(time[i]) for i in presses(time, np.stack([left, right], 1), 0.3, 6)]
    assert len(found) in (3, 4)  # the short one on the right may count as part of the jam
    assert 2 < found[0] < 8
    assert 12 <= found[-2] <= 13
    assert 15 <= found[-1] <= 16.5
    assert len(presses(time, np.stack([left, right], 1), 0.3, 2)) == 2
    leaning = 5.0 + np.where((time % 5 > 2) & (time % 5 < 3), 8.0, 0.0)
    assert len(presses(time, leaning[:, None], 0.3, 6)) == 4
    assert presses(time, np.zeros((len(time), 3)), 0.3, 6) == []
    assert presses([], np.zeros((0, 3)), 0.3, 6) == []


def test_early_clock_estimates_do_not_set_the_scale(board: BoardSeries) -> None:
    track = Track()
    rng = np.random.default_rng(2)
    for second in range(60):
        error = 4000e-6 if second < 3 else 40e-6 + 5e-6 * rng.normal()
        track.add(board.first + second / 30, {"clock_rate_error": f"{error}"})
    look = LOOKS["screen"]
    with styled(look):
        figure = laid_out(
            curves.timing_sheet(dataclasses.replace(board, diagnostics_track=track), look)
        )
    (axes,) = [a for a in figure.axes if "ppm" in a.get_ylabel()]
    low, high = axes.get_ylim()
    assert 0 < low < high < 100
    assert any("3 points, 4e+03" in t.get_text() for t in axes.get_legend().texts)


def test_board_of_very_many_arrays_is_drawn_partially_with_a_note(board: BoardSeries) -> None:
    times = 40
    geometry = SimpleNamespace(
        array_side=[0] * times, array_rows=[2] * times, array_columns=[2] * times,
        array_name=[f"array_{i}" for i in range(times)], model="patch",
        surface=np.tile([[0, 0], [0.01, 0], [0, 0.01], [0.01, 0.01]], (times, 1)).ravel(),
        position=np.zeros(3 * 4 * times),
    )  # fmt: skip
    forces = Track()
    rng = np.random.default_rng(3)
    for time in board.time:
        forces.add(time, -np.abs(rng.normal(size=(4 * times, 3))).astype(np.float32))
    many = dataclasses.replace(
        board, geometry=geometry, force_track=forces, feature_track=Track(), ambient_track=Track()
    )
    with styled(LOOKS["column"]):
        figure = laid_out(skin.overview_sheet(many, look=LOOKS["column"]))
    keys = [t.get_text() for legend in figure.legends for t in legend.texts]
    assert "28 arrays that bear less are not drawn" in keys
