"""Every frame of an array is accounted for, in any order of arrival."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from tactiled.boards.board import HISTORY, SequenceTracker, Verdict


def take_all(numbers: list[int]) -> tuple[SequenceTracker, list[Verdict]]:
    tracker = SequenceTracker()
    return tracker, [tracker.take(n % 2**32) for n in numbers]


def test_gap_is_counted() -> None:
    tracker, _ = take_all([1, 2, 6, 7])
    assert (tracker.accepted, tracker.missing) == (4, 3)


def test_duplicate_is_used_once() -> None:
    tracker, verdicts = take_all([1, 2, 2, 3])
    assert verdicts[2] is Verdict.DUPLICATE
    assert (tracker.accepted, tracker.duplicate, tracker.missing) == (3, 1, 0)


def test_late_frame_fills_its_gap_but_is_not_used() -> None:
    tracker, verdicts = take_all([1, 3, 2, 4])
    assert verdicts == [Verdict.FRESH, Verdict.FRESH, Verdict.LATE, Verdict.FRESH]
    assert (tracker.accepted, tracker.late, tracker.missing) == (3, 1, 0)


def test_sequence_numbers_wrap() -> None:
    tracker, verdicts = take_all([2**32 - 2, 2**32 - 1, 0, 1])
    assert set(verdicts) == {Verdict.FRESH}
    assert tracker.missing == 0


def test_number_far_behind_is_from_another_stream() -> None:
    _, verdicts = take_all([1000, 1000 - HISTORY, 1001])
    assert verdicts[1] is Verdict.FOREIGN


def test_after_silence_lower_numbers_restart_and_higher_leave_a_gap() -> None:
    tracker, _ = take_all([100])
    tracker.resume()
    assert tracker.take(5) is Verdict.FRESH
    assert tracker.missing == 0
    tracker.resume()
    assert tracker.take(10) is Verdict.FRESH
    assert tracker.missing == 4


@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.tuples(st.booleans(), st.integers(0, 3), st.integers(0, 8)), max_size=200),
)
@settings(max_examples=50, deadline=None)
def test_sent_is_accepted_plus_late_plus_missing(
    first: int, fates: list[tuple[bool, int, int]]
) -> None:
    """Each frame may be lost, repeated, or overtaken by up to eight others."""
    arrivals: list[tuple[int, int]] = []
    for n, (lost, copies, hold) in enumerate(fates):
        if not lost:
            arrivals += [(n + hold, n)] * (1 + copies)
    arrivals.sort()
    numbers = [n for _, n in arrivals]
    tracker = SequenceTracker()
    for n in numbers:
        assert tracker.take((first + n) % 2**32) is not Verdict.FOREIGN
    if numbers:
        before_first = {n for n in numbers if n < numbers[0]}
        sent = max(numbers) - numbers[0] + 1
        assert sent == tracker.accepted + tracker.late + tracker.missing
        repeats = len(numbers) - len(set(numbers) - before_first)
        assert tracker.duplicate == repeats
