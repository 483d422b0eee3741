"""Pictures of every kind of log, also where something is missing, in bounded memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from tactile_tools.cli import main
from tactile_tools.plot.series import BoardSeries, Spread, Track, read_boards
from tests.support import virtual_daemon
from tests.support.log_rewriting import rewrite


@pytest.fixture(scope="module")
def skin_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated finger that is pressed on its left side."""
    path = tmp_path_factory.mktemp("skin") / "run.mcap"
    daemon = virtual_daemon.VirtualDaemon(
        path,
        [virtual_daemon.make_board(contacts=virtual_daemon.press, rate=50.0)],
        [virtual_daemon.calibration()],
    )
    daemon.run(2.2)
    daemon.close()
    return path


def picture(path: Path) -> Any:
    """Pixels; a picture with nothing drawn is all white."""
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[0] > 500
    assert (pixels[..., :3].min(axis=2) < 0.9).mean() > 0.005
    return pixels


def test_every_picture_is_drawn_without_a_display(skin_log: Path, tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MPLBACKEND")}
    done = subprocess.run(
        [sys.executable, "-m", "tactile_tools.cli", "plot", str(skin_log), "--out",
         str(tmp_path / "overview.png")],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    drawn = [picture(tmp_path / "overview.png")]
    for what in ("taxels", "forces", "field", "timing"):
        out = tmp_path / f"{what}.png"
        assert main(["plot", str(skin_log), "--what", what, "--out", str(out)]) == 0
        drawn.append(picture(out))
    sizes = [pixels.shape for pixels in drawn]
    assert len({(shape, float(p.mean())) for shape, p in zip(sizes, drawn, strict=True)}) == 5


@pytest.mark.parametrize(("size", "inches"), [("column", 3.5), ("page", 7.1)])
def test_paper_picture_has_the_requested_width(
    size: str, inches: float, skin_log: Path, tmp_path: Path
) -> None:
    words = ["plot", str(skin_log), "--what", "forces", "--size", size]
    out = tmp_path / "a.png"
    assert main([*words, "--dpi", "120", "--out", str(out)]) == 0
    assert picture(out).shape[1] == pytest.approx(120 * inches, abs=1)


def test_vector_formats_are_written_beside_the_log_deterministically(
    skin_log: Path, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes(skin_log.read_bytes())
    for suffix, begin in (("pdf", b"%PDF"), ("svg", b"<?xml")):
        written = []
        for _ in range(2):
            assert main(["plot", str(log), "--what", "field", "--format", suffix]) == 0
            written.append(log.with_suffix(f".{suffix}").read_bytes())
        assert written[0] == written[1]
        assert written[0].startswith(begin)


def test_drawn_board_of_two_is_named(
    skin_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def with_thumb(topic: str, at: int, message: Any) -> list[tuple[str, int, Any]]:
        return [(topic, at, message), (topic.replace("finger", "thumb_2"), at, message)]

    log = rewrite(skin_log, tmp_path / "two.mcap", with_thumb)
    words = ["plot", str(log), "--what", "forces"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "drawn: board finger (of 2: finger, thumb_2); choose with --board" in said
    assert main([*words, "--name", "thumb_2"]) == 0
    assert "choose" not in capsys.readouterr().out


def test_strongest_moment_is_the_press(skin_log: Path) -> None:
    from tactile_tools.plot.skin import strongest

    board = read_boards(skin_log)["finger"]
    (moment,) = strongest(board, 1)
    force = np.nan_to_num(-board.force[moment][:, 2])
    assert board.time[moment] > 1.0
    assert 0 <= int(force.argmax()) < 32  # on the left array
    assert force.sum() == pytest.approx(3.0, rel=0.5)


def test_bad_arguments_are_refused(
    skin_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    note = tmp_path / "x.mcap"
    note.write_bytes(b"no log")
    for words, code, text in (
        ([skin_log, "--what", "reach"], 3, "holds no reach"),
        ([skin_log, "--name", "thumb"], 2, "no board 'thumb' in the log; it holds finger"),
        ([skin_log, "--at", "99", "--what", "taxels"], 2, "--at 99; the log of finger goes from"),
        ([skin_log, "--out", tmp_path / "a.gif"], 2, "allowed: a file that ends in"),
        ([skin_log, "--out", tmp_path / "no" / "a.png"], 2, "no such folder"),
        ([skin_log, "--format", "pdf", "--out", tmp_path / "a.png"], 2, "say two things"),
        ([skin_log, "--dpi", "9"], 2, "--dpi 9; allowed: 30 to 600"),
        ([skin_log, "--what", "forces", "--reach", "1"], 2, "leave them out with forces"),
        ([skin_log, "--reach", "1"], 3, "holds no reach"),
        ([note], 3, "is not an MCAP file"),
        ([tmp_path / "none.mcap"], 2, "does not exist"),
    ):
        assert main(["plot", *map(str, words)]) == code, words
        said = capsys.readouterr().err
        assert text in said
        assert "Traceback" not in said


def test_long_log_keeps_its_peaks_in_bounded_memory() -> None:
    track = Track(limit=1000)
    for i in range(100_000):
        track.add(i * 0.01, i, 50.0 if i == 31_415 else 1.0)
    assert len(track) <= 1000
    assert 31_415 in track.items
    assert track.time == sorted(track.time)
    assert track.items[0] < 200
    assert track.items[-1] > 99_000


def test_percentiles_are_accurate_to_six_per_cent() -> None:
    spread = Spread()
    rng = np.random.default_rng(3)
    values = rng.lognormal(-6, 1, 20_000)
    for value in values:
        spread.add(float(value))
    for share in (0.5, 0.99):
        assert spread.percentile(share) == pytest.approx(np.quantile(values, share), rel=0.07)
    assert spread.greatest == values.max()
    assert spread.number == len(values)


def test_board_without_compensation_or_clock_is_drawn(skin_log: Path, tmp_path: Path) -> None:
    from tactile_tools.plot.curves import draw_field, draw_timing
    from tactile_tools.plot.skin import draw

    board = read_boards(skin_log)["finger"]
    bare = BoardSeries(
        "bare", geometry=board.geometry, cycles=board.cycles, first=board.first, last=board.last,
        force_track=board.force_track, delay_track=board.delay_track,
    )  # fmt: skip
    for drawer in (draw, draw_field, draw_timing):
        drawer(bare, tmp_path / "bare.png")
        picture(tmp_path / "bare.png")
