"""The simulator writes as published sketches do, and each format is read or detected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.layouts import TextDecoder
from sensor_proto.survey import Survey
from sim_device.board.anyskin import SKETCHES, AnySkinBoard, writer_of
from sim_device.board.catalogue import build_skin, factory_calibration
from sim_device.ports_plan import BoardsRequest, plan_boards
from tactile_core.geometry import Side
from tactile_core.types import Instant

MS = 1_000_000


def stream(board: AnySkinBoard, until_ms: int) -> list[bytes]:
    return [board.tick(Instant(ms * MS)) for ms in range(0, until_ms, 5)]


@pytest.mark.parametrize("name", [name for name in SKETCHES if name != "anyskin"])
def test_every_sketch_format_is_detected_and_read(name: str) -> None:
    usual = AnySkinBoard(build_skin("anyskin", 3))
    fields = [r.message.field_ut for r in AnySkinDecoder().feed(b"".join(stream(usual, 800)))]
    board = AnySkinBoard(build_skin("anyskin", 3), write=writer_of(name, 5), banner=True)
    chunks = stream(board, 800)
    watch = Survey()
    for chunk in chunks:
        watch.feed(chunk)
    found = watch.judge()
    assert found is not None
    assert found.layout is not None
    decoder = TextDecoder(found.layout)
    got = [r.message.field_ut for chunk in chunks for r in decoder.feed(chunk)]
    assert len(got) >= len(fields) - 3
    chips = found.layout.chips
    step = 0.06 if name == "touch-text" else 0.006
    np.testing.assert_allclose(got[-1], fields[-1][:chips], atol=step)


def test_layout_is_written_and_read() -> None:
    write = writer_of("int16:5txyz,big,start=aa55,check=sum", 5)
    board = AnySkinBoard(build_skin("anyskin", 3), write=write)
    watch = Survey()
    chunks = stream(board, 800)
    for chunk in chunks:
        watch.feed(chunk)
    found = watch.judge()
    assert found is not None
    assert found.declare == ("int16:5txyz,big,start=aa55,check=sum,end=none",)
    with pytest.raises(ValueError, match="of 4 chips, the board has 5"):
        writer_of("floats:4xyz", 5)
    with pytest.raises(ValueError, match="anyskin-text"):
        writer_of("sketch", 5)


def test_boards_of_one_controller_sit_on_different_sides() -> None:
    skin = build_skin("anyskin", 1, (5, 5, 5))
    assert [a.side for a in skin.geometry.arrays] == [Side.LEFT, Side.RIGHT, Side.TIP]
    data = b"".join(stream(AnySkinBoard(skin), 400))
    decoder = AnySkinDecoder()
    decoder.feed(data)
    assert decoder.magnetometers == 15
    made = factory_calibration("anyskin", 1, (5, 5))
    assert made.geometry.posed
    assert [a.geometry.name for a in made.arrays] == ["skin0", "skin1"]
    # The earth's field is the same for both; what their chips see of it is turned.
    first, second = (a.geometry.rotation[0] for a in made.arrays)
    assert not np.allclose(first, second)


@pytest.mark.parametrize(
    "options",
    [{"arrays": (5, 5)}, {"format": "reskin-text"}, {"banner": True}],
)
def test_other_formats_are_for_float_boards_only(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="--kind anyskin"):
        plan_boards(BoardsRequest(ptys=(Path("a"),), **options))  # type: ignore[arg-type]
    (planned,) = plan_boards(BoardsRequest(ptys=(Path("a"),), board="anyskin", **options))  # type: ignore[arg-type]
    assert planned.connect.startswith("tactiled --port a")
