"""Repeated messages give few lines, with a summary."""

from __future__ import annotations

import logging
from collections.abc import Callable

from tactile_core.types import Instant
from tactiled.watch import FEW, KINDS, WINDOW_S, Repeats, Silences

At = Callable[[float], Instant]


def test_repeated_short_silences_give_one_line(instant: At) -> None:
    silences, said = Silences(), []
    for k in range(100):
        now = k * 0.1
        if k % 10 == 0:
            said.append(silences.fell(0.2, instant(now)))
        if k % 10 == 3:
            said.append(silences.ended(0.3))
        said.append(silences.due(instant(now)))
    assert [text for text in said if text] == [
        "no samples for 0.20 s",
        "samples again after 0.30 s",
    ]
    assert silences.due(instant(WINDOW_S)) == "9 short silences in 10 s, longest 0.3 s"
    assert silences.due(instant(2 * WINDOW_S)) is None
    assert silences.fell(0.2, instant(25.0)) == "no samples for 0.20 s"


def test_lasting_silence_is_reported_after_short_ones(instant: At) -> None:
    silences = Silences()
    assert silences.fell(0.2, instant(0.0))
    assert silences.ended(0.4)
    assert silences.fell(0.2, instant(1.0)) is None
    assert silences.due(instant(2.0)) is None
    assert silences.due(instant(3.0)) == "no samples for 2.2 s"
    assert silences.due(instant(4.0)) is None
    assert silences.ended(5.0) == "samples again after 5.00 s"


def test_unplugged_board_is_not_also_called_silent(instant: At) -> None:
    silences = Silences()
    assert silences.fell(0.2, instant(0.0))
    silences.ended(0.3)
    silences.fell(0.2, instant(1.0))
    silences.gone()
    assert silences.due(instant(5.0)) is None


def test_first_few_of_a_kind_are_reported_and_the_rest_counted(instant: At) -> None:
    repeats, told = Repeats(), 0
    for k in range(50):
        told += repeats.should_report("restart", f"restart {k}", logging.WARNING, instant(k * 0.1))
    assert told == FEW
    assert repeats.should_report("other", "once", logging.INFO, instant(5.0))
    assert repeats.due(instant(9.9)) == []
    assert repeats.due(instant(10.0)) == [(logging.WARNING, "47 times more in 10 s: restart 49")]
    assert not repeats.should_report("restart", "restart 50", logging.WARNING, instant(11.0))
    assert repeats.due(instant(20.0)) == [(logging.WARNING, "once more in 10 s: restart 50")]
    assert repeats.due(instant(40.0)) == []
    assert repeats.should_report("restart", "restart 51", logging.WARNING, instant(41.0))


def test_memory_for_kinds_of_messages_is_bounded(instant: At) -> None:
    repeats = Repeats()
    for k in range(10 * KINDS):
        assert repeats.should_report(f"kind {k}", "text", logging.INFO, instant(0.0))
    assert len(repeats._windows) == KINDS
