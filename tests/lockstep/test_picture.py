"""The picture of a reach shows something, and what it cannot show it says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colors
from matplotlib.image import imread

from tactile_tools.cli import main
from tactile_tools.plots import reach as plot_reach
from tactile_tools.plots.reach import draw_reach
from tactile_tools.plots.reach_series import read_reach
from tactile_tools.plots.series import LogUnreadableError

Recorded = Callable[..., tuple[int, Path]]


def share(picture: np.ndarray, colour: str) -> float:
    """Part of the pixels that have just this colour."""
    wanted = np.array(colors.to_rgb(colour))
    return float(np.mean(np.abs(picture[..., :3] - wanted).max(axis=-1) < 0.02))


@pytest.mark.parametrize("depth", ["contacts", "taxels"])
def test_path_contacts_target_and_curves_are_there(recorded: Recorded, depth: str) -> None:
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


def test_of_several_reaches_the_last_is_drawn(recorded: Recorded) -> None:
    """As in a log of ``reachd --serve``."""
    _, log = recorded("contacts")
    reach = read_reach(log)
    assert reach.first_world is not None
    assert {m.ns for m in reach.first_world.markers} >= {"objects", "cupboard", "goal"}
    assert reach.ended


def test_a_log_without_a_reach_is_refused(tmp_path: Path) -> None:
    from tactile_bus.instant import WallClock
    from tactile_bus.recorder import Recorder

    path = tmp_path / "empty.mcap"
    Recorder(path, clock=WallClock(0)).close(10.0)
    with pytest.raises(LogUnreadableError, match="holds no reach"):
        draw_reach(path, tmp_path / "out.png")
    with pytest.raises(LogUnreadableError):
        draw_reach(tmp_path / "none.mcap", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


def test_plot_draws_it_too(recorded: Recorded, tmp_path: Path) -> None:
    _, log = recorded("contacts")
    out = tmp_path / "again.png"
    assert main(["plot", str(log), "--what", "reach", "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000
