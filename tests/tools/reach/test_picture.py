"""A picture of a reach shows the data, and says what it cannot show."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import colors
from matplotlib.image import imread

from tactile_tools.cli import main
from tactile_tools.plot import reach as plot_reach
from tactile_tools.plot.curves import holes
from tactile_tools.plot.look import LOOKS, styled
from tactile_tools.plot.reach import draw_reach
from tactile_tools.plot.reach_series import read_reach
from tactile_tools.plot.series import LogUnreadableError
from tests.support.log_rewriting import rewrite

Recorded = Callable[..., tuple[int, Path]]


def share(picture: np.ndarray, colour: str) -> float:
    """Share of the pixels that have exactly this colour."""
    wanted = np.array(colors.to_rgb(colour))
    return float(np.mean(np.abs(picture[..., :3] - wanted).max(axis=-1) < 0.02))


@pytest.mark.parametrize("depth", ["contacts", "taxels"])
def test_picture_shows_path_contacts_target_and_curves(recorded: Recorded, depth: str) -> None:
    _, log = recorded(depth)
    picture = imread(log.with_suffix(".png"))
    height, width = picture.shape[:2]
    assert (width, height) >= (1200, 700)
    above, curves = picture[:, : width // 2], picture[:, width // 2 :]
    for part in (above, curves):
        assert 0.2 < share(part, "white") < 0.95
    done = {s.activity for s in read_reach(log).states}
    for activity in done & set(plot_reach.ACTIVITIES):
        assert share(above, plot_reach.ACTIVITIES[activity]) > 5e-5, activity
    assert share(above, "#F0E442") > 5e-5, "the target"
    assert share(above, plot_reach.TOUCHED) > 1e-4, "contacts and moved objects"
    assert share(curves, plot_reach.TOUCHED) > 1e-4, "forces"


@pytest.fixture(scope="module")
def several(recorded: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log as of ``reachd --serve``: two reaches 60 s apart; the first has a second board and
    arm."""
    _, log = recorded("contacts")

    def edit(topic: str, at: int, message: Any) -> list[tuple[str, int, Any]]:
        later = copy.deepcopy(message)
        for name in ("captured_ns", "stamped_ns"):
            if hasattr(later, name):
                setattr(later, name, getattr(later, name) + 60 * 10**9)
        if topic == "/reach/reach/state":
            later.strategy = "my_own:_Strategy"
        rows = [(topic, at, message), (topic, at + 60 * 10**9, later)]
        if topic in ("/tactile/finger/features", "/arm/arm/state") and at % 50_000_000 == 0:
            rows.append((topic.replace("finger", "thumb").replace("arm/arm", "arm/b"), at, message))
        return rows

    return Path(rewrite(log, tmp_path_factory.mktemp("several") / "served.mcap", edit))


def test_any_of_several_reaches_and_boards_can_be_chosen(
    several: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    last, first = read_reach(several), read_reach(several, 1)
    assert (last.number, first.number, len(last.all_reaches)) == (2, 1, 2)
    assert (last.states[-1].strategy, first.states[-1].strategy) == (
        "my_own:_Strategy",
        "hybrid_event",
    )
    assert len(last.states) == len(first.states)
    assert last.ended
    assert {m.ns for m in last.first_world.markers} >= {"objects", "cupboard", "goal"}
    assert first.board_name == "finger"
    assert sorted(first.boards) == ["finger", "thumb"]
    thumb = read_reach(several, 1, "thumb", "b")
    assert 0 < len(thumb.touch) < len(first.touch)
    assert 0 < len(thumb.arm) < len(first.arm)
    out = tmp_path / "a.png"
    words = ["plot", str(several), "--out", str(out), "--dpi", "40"]
    assert main([*words, "--reach", "1"]) == 0
    printed = capsys.readouterr().out
    assert "drawn: board finger (of 2: finger, thumb); choose with --board" in printed
    assert "drawn: arm arm (of 2: arm, b); choose with --arm" in printed
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "drawn: reach 2 of 2; choose with --reach" in printed
    assert "  1  hybrid_event, " in printed
    assert "  2  my_own:_Strategy, " in printed
    for wrong, text in (
        (["--reach", "3"], "no reach 3 in the log; it holds 2"),
        (["--board", "palm"], "no board 'palm' was heard during this reach, but finger"),
        (["--arm", "c"], "no arm 'c' was heard during this reach, but arm"),
    ):
        assert main([*words, *wrong]) == 2
        assert text in capsys.readouterr().err
    with pytest.raises(SystemExit) as refused:
        main([*words, "--reach", "0"])
    assert refused.value.code == 2
    assert "allowed: a whole number of at least 1" in capsys.readouterr().err


@pytest.mark.parametrize("size", LOOKS)
def test_labels_of_a_reach_stay_inside_the_picture_and_off_the_data(
    several: Path, size: str
) -> None:
    reach = read_reach(several)
    with styled(LOOKS[size]):
        figure = plot_reach.reach_sheet(reach, LOOKS[size]).finish()
        figure.canvas.draw()
    whole, inches = figure.bbox, figure.get_tightbbox()
    assert min(inches.x0, inches.y0) * figure.dpi >= -1
    assert inches.x1 * figure.dpi <= whole.x1 + 1
    assert inches.y1 * figure.dpi <= whole.y1 + 1
    assert "reach 2 of 2" in figure._suptitle.get_text()
    assert "my_own:_Strategy" in figure._suptitle.get_text()
    legends = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    assert len(legends) == 3
    for legend in legends:
        box = legend.get_window_extent().padded(-1)
        for axes in figure.axes:
            assert not box.overlaps(axes.get_window_extent().padded(-1))
            assert not box.overlaps(axes.xaxis.label.get_window_extent())
    above, _, force, _ = figure.axes
    numbers = [t for t in force.texts if t.get_text().isdigit()]
    assert len(numbers) == len([t for t in above.texts if t.get_text().isdigit()]) >= 2
    curves = max(np.nanmax(line.get_ydata()) for line in force.lines if len(line.get_ydata()) > 9)
    assert all(t.get_position()[1] > curves for t in numbers)


def test_missing_data_is_not_drawn(recorded: Recorded, tmp_path: Path) -> None:
    """Neither a path nor bars through it, nor contacts whose place is unknown."""
    _, log = recorded("contacts")
    start = read_reach(log)
    begin, end = 0.4 * start.time[-1], 0.6 * start.time[-1]

    def cut(topic: str, at: int, message: Any) -> list[tuple[str, int, Any]]:
        stamp = getattr(message, "captured_ns", getattr(message, "stamped_ns", start.start_ns))
        inside = begin < (stamp - start.start_ns) * 1e-9 < end
        return [] if inside and not topic.endswith("features") else [(topic, at, message)]

    reach = read_reach(rewrite(log, tmp_path / "hole.mcap", cut))
    (hole,) = holes(reach.time)
    assert hole == pytest.approx((begin, end), abs=0.1)
    with styled(LOOKS["screen"]):
        figure = plot_reach.reach_sheet(reach, LOOKS["screen"]).figure
    above, distance, _, doing = figure.axes
    for line in [*above.lines, *distance.lines]:
        x = np.asarray(line.get_xdata(), float)
        if line.get_zorder() == 5 or len(x) > 100:
            jumps = np.abs(np.diff(np.asarray(line.get_xydata()), axis=0)).max(axis=1)
            assert np.nanmax(jumps, initial=0.0) < 0.3
    for bar in doing.patches:
        if bar.get_height() < 1:  # the shade is as high as the axes
            assert bar.get_x() + bar.get_width() < hole[0] + 0.1 or bar.get_x() > hole[1] - 0.1
    known = reach.placed()
    lost = [i for i, t in enumerate(reach.touch_time) if hole[0] + 0.1 < t < hole[1] - 0.1]
    assert lost
    assert not known[lost].any()
    assert known.mean() > 0.7
    assert not set(lost) & set(reach.moments(6, 0.0))


def test_log_without_a_reach_is_refused(tmp_path: Path) -> None:
    from tactile_core.log.recorder import Recorder
    from tactile_core.types import WallClock

    path = tmp_path / "empty.mcap"
    Recorder(path, clock=WallClock(0)).close(60)
    with pytest.raises(LogUnreadableError, match="holds no reach"):
        draw_reach(path, tmp_path / "out.png")
    with pytest.raises(LogUnreadableError):
        draw_reach(tmp_path / "none.mcap", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


def test_plot_command_draws_a_reach(recorded: Recorded, tmp_path: Path) -> None:
    _, log = recorded("contacts")
    out = tmp_path / "again.png"
    assert main(["plot", str(log), "--what", "reach", "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000
