"""Inputs are used only from one publisher, intact, in order, and stamped by a known clock."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reachd.inputs import DUPLICATE_FOR, Input, RemoteClock, SourcePin, Verdict, make_touch
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.streams import BusSample
from tactile_core.bus.topics import FEATURES
from tactile_core.geometry import Side
from tactile_core.types import NS_PER_S, Instant, after

A, B = b"a" * 16, b"b" * 16
TAKEOVER = 0.2


def at(seconds: float) -> Instant:
    return after(Instant(5 * NS_PER_S), seconds)


def sample(sequence: int | None, source: bytes | None = A, data: bytes = b"") -> BusSample:
    return BusSample("key", data or str(sequence).encode(), sequence, 0, source)


def features(captured: int, **changes: Any) -> Any:
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    values = {
        "header": header(0, "ee"), "captured_ns": captured, "received_ns": captured,
        "uncertainty": 0.0, "sequence": 1, "valid": True, "reasons": [], "calibrated": True,
        "peak_force": 2.5, "peak_side": 1, "peak_position": MSG.Point(0.1, 0.028, 0.0),
        "normal_force": 4.0, "wrench": MSG.Wrench(zero, zero), "tip_force": 0.5,
        "tip_contact_time": 0.0, "taxels_in_contact": 2, "taxels_masked": 0, "patches": [],
        "reason_codes": [], "peak_force_bound": 0.1, "normal_force_bound": 0.1,
        "tip_force_bound": 0.1,
    }  # fmt: skip
    return MSG.ContactFeatures(**(values | changes))


def encoded(captured: int, **changes: Any) -> bytes:
    return codec().encode(FEATURES, features(captured, **changes))


def touch_input(*, remote: bool = False) -> Input[Any]:
    return Input(FEATURES, make_touch, TAKEOVER, remote=remote)


def test_single_ordered_publisher_is_accepted() -> None:
    pin = SourcePin(TAKEOVER)
    assert [pin.judge(sample(n), at(n * 0.01)) for n in (1, 2, 5)] == [Verdict.ACCEPTED] * 3
    assert not pin.duplicated(at(0.05))


def test_second_publisher_is_refused_and_reported_for_a_while() -> None:
    pin = SourcePin(TAKEOVER)
    pin.judge(sample(1), at(0.0))
    assert pin.judge(sample(9, B), at(0.01)) is Verdict.DUPLICATE
    assert pin.judge(sample(2), at(0.02)) is Verdict.ACCEPTED
    assert pin.duplicated(at(0.02))
    assert pin.duplicated(at(0.01 + DUPLICATE_FOR - 0.001))
    assert not pin.duplicated(at(0.01 + DUPLICATE_FOR))


@pytest.mark.parametrize(("silent", "verdict"), [(0.199, "DUPLICATE"), (0.2, "ACCEPTED")])
def test_restarted_publisher_is_accepted_after_silence(silent: float, verdict: str) -> None:
    pin = SourcePin(TAKEOVER)
    pin.judge(sample(100), at(0.0))
    assert pin.judge(sample(1, B), at(silent)).name == verdict


def test_returning_first_publisher_puts_both_in_doubt() -> None:
    pin = SourcePin(TAKEOVER)
    pin.judge(sample(100), at(0.0))
    pin.judge(sample(1, B), at(0.3))
    assert pin.judge(sample(101), at(0.31)) is Verdict.DUPLICATE
    assert pin.duplicated(at(0.31))


def test_forger_with_the_same_id_is_detected_by_order() -> None:
    pin = SourcePin(TAKEOVER)
    pin.judge(sample(10), at(0.0))
    assert pin.judge(sample(900, data=b"forged"), at(0.001)) is Verdict.ACCEPTED
    assert pin.judge(sample(11), at(0.01)) is Verdict.DUPLICATE
    again = SourcePin(TAKEOVER)
    again.judge(sample(10), at(0.0))
    assert again.judge(sample(10, data=b"forged"), at(0.001)) is Verdict.DUPLICATE


def test_forged_sequence_number_does_not_lock_out_the_publisher() -> None:
    """It is reported, and after the takeover time the first publisher is accepted again."""
    pin = SourcePin(TAKEOVER)
    pin.judge(sample(10), at(0.0))
    pin.judge(sample(2**60, data=b"forged"), at(0.001))
    heard = [pin.judge(sample(11 + k), at(0.01 * (k + 1))) for k in range(40)]
    assert heard[0] is Verdict.DUPLICATE
    assert heard[-1] is Verdict.ACCEPTED
    assert heard.index(Verdict.ACCEPTED) <= 20
    assert set(heard[20:]) == {Verdict.ACCEPTED}
    assert pin.duplicated(at(0.2))
    last = sample(51)
    assert pin.judge(last, at(0.9)) is Verdict.ACCEPTED
    assert pin.judge(last, at(2.0)) is Verdict.REPEATED, "the very same, however late"


def test_sample_arriving_over_two_links_is_used_once() -> None:
    pin = SourcePin(TAKEOVER)
    pin.judge(sample(10), at(0.0))
    assert pin.judge(sample(10), at(0.001)) is Verdict.REPEATED
    assert not pin.duplicated(at(0.001))


def test_anonymous_publisher_is_never_trusted() -> None:
    pin = SourcePin(TAKEOVER)
    assert pin.judge(sample(None, None), at(0.0)) is Verdict.ANONYMOUS
    pin.judge(sample(1), at(0.01))
    assert pin.judge(sample(None, None), at(0.02)) is Verdict.DUPLICATE
    assert pin.duplicated(at(0.02))


def test_features_keep_the_stamp_of_the_sender() -> None:
    source = touch_input()
    source.take(sample(1, data=encoded(at(0.5))), at(0.51))
    touch: Any = source.value
    assert (touch.captured, touch.received) == (at(0.5), at(0.51))
    assert (touch.valid, touch.peak_side) == (True, Side.LEFT)
    assert (touch.peak_x, touch.peak_y) == (0.1, 0.028)
    assert (touch.peak_force, touch.total_force, touch.tip_force) == (2.5, 4.0, 0.5)


@pytest.mark.parametrize("data", [b"", b"\x00\x01", b"x" * 300])
def test_garbage_keeps_the_last_value_which_ages(data: bytes) -> None:
    source = touch_input()
    source.take(sample(1, data=encoded(at(0.0))), at(0.0))
    before = source.value
    source.take(BusSample("key", data, 2, 0, A), at(0.1))
    assert source.value is before
    assert source.counters["malformed"] == 1


def test_unknown_side_is_not_a_touch() -> None:
    source = touch_input()
    source.take(sample(1, data=encoded(at(0.0), peak_side=77)), at(0.0))
    assert source.value is None
    assert source.counters == source.counters | {"malformed": 1, "accepted": 0}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=400), st.integers(-3, 3)), max_size=12))
def test_arbitrary_bytes_never_raise(received: list[tuple[bytes, int]]) -> None:
    source = touch_input()
    for index, (data, sequence) in enumerate(received):
        source.take(BusSample("key", data, sequence, None, A), at(index * 0.01))
    assert sum(source.counters.values()) == len(received)


def test_remote_clock_is_mapped_by_the_fastest_message() -> None:
    clock, apart = RemoteClock(), 3_600 * NS_PER_S
    assert clock.here(at(0.0) - apart, at(0.005)) == at(0.005)
    # 2 ms faster: so the first was 2 ms old when it came, which could not be known then.
    assert clock.here(at(0.1) - apart, at(0.103)) == at(0.103)
    late = clock.here(at(0.2) - apart, at(0.5))
    assert (at(0.5) - late) / NS_PER_S == pytest.approx(0.297, abs=1e-3)


def test_growing_queue_shows_as_age() -> None:
    """Row 21: data come later and later, without a gap."""
    source = touch_input(remote=True)
    for n in range(200):
        sent = n * 0.01
        source.take(sample(n + 1, data=encoded(at(sent - 50.0))), at(sent + 0.002 + 0.1 * sent))
    touch: Any = source.value
    assert (touch.received - touch.captured) / NS_PER_S == pytest.approx(0.199, abs=0.005)


def test_clock_drift_does_not_show_as_age() -> None:
    clock = RemoteClock()
    for n in range(1000):
        sent = n * 1.0
        here = clock.here(round(at(sent) * (1 - 5e-5)), at(sent + 0.001))
    assert at(sent + 0.001) == here


def test_restarted_remote_sender_is_mapped_again() -> None:
    source = touch_input(remote=True)
    source.take(sample(1, data=encoded(at(0.0))), at(0.0))
    source.take(sample(1, B, data=encoded(at(-1000.0))), at(1.0))
    touch: Any = source.value
    assert touch.captured == at(1.0)
