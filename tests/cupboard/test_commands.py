"""Whose commands an arm obeys, and which."""

from __future__ import annotations

import math
from collections.abc import Callable

from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.arm_commands import TAKEOVER, CommandInput
from tactile_bus.arm_types import Twist
from tactile_bus.instant import Instant, after
from tactile_bus.streams import BusSample

Encode = Callable[..., bytes]
T0 = Instant(5_000_000_000)
A, B = b"a" * 16, b"b" * 16
AHEAD, BACK = Twist(0.02, 0.0, 0.1), Twist(-0.02, 0.0, 0.0)


def sample(data: bytes, sequence: int | None, source: bytes | None) -> BusSample:
    return BusSample("arm/arm/cmd_vel", data, sequence, 1, source)


def offer(commands: CommandInput, given: BusSample, now: Instant) -> Twist | None:
    """As the arm meets a sample: seen by the watch, then fetched as the newest."""
    commands.watch(given, now)
    return commands.take(given, now)


def test_the_first_commander_is_obeyed_and_a_second_is_not(encode_command: Encode) -> None:
    commands = CommandInput()
    ahead, back = encode_command(AHEAD), encode_command(BACK)
    for k in range(200):  # both for 2 s
        now = after(T0, k * 0.01)
        assert offer(commands, sample(ahead, k + 1, A), now) == AHEAD
        assert offer(commands, sample(back, k + 1, B), now) is None
    assert commands.refused["foreign"] == 200
    assert commands.commander == A.hex()
    # Silent for long enough, the first makes way; when it comes back it is the second.
    assert offer(commands, sample(back, 300, B), after(now, TAKEOVER - 0.01)) is None
    later = after(now, TAKEOVER + 0.01)
    assert offer(commands, sample(back, 301, B), later) == BACK
    assert offer(commands, sample(ahead, 201, A), later) is None


def test_a_watch_that_runs_ahead_takes_nothing_from_the_newest(encode_command: Encode) -> None:
    commands = CommandInput()
    for k in range(1, 4):
        commands.watch(sample(encode_command(AHEAD), k, A), T0)
    assert commands.take(sample(encode_command(AHEAD), 3, A), T0) == AHEAD
    assert commands.take(sample(encode_command(BACK), 2, A), T0) is None  # older than the last
    assert not any(commands.refused.values())


def test_what_is_no_command_is_refused_and_counted(encode_command: Encode) -> None:
    commands = CommandInput()
    cases = {
        "anonymous": sample(encode_command(AHEAD), None, None),
        "malformed": sample(b"\x00\x01\x00\x00nonsense", 2, A),
        "wrong_frame": sample(encode_command(AHEAD, frame="map"), 3, A),
        "not_planar": sample(encode_command(AHEAD, z=0.01), 4, A),
        "foreign": sample(encode_command(BACK), 1, A),  # the first one's name, an old number
    }
    assert offer(commands, sample(encode_command(AHEAD), 1, A), T0) == AHEAD
    for reason, case in cases.items():
        before = commands.refused
        assert offer(commands, case, T0) is None
        assert commands.refused == before | {reason: 1}
    again = sample(encode_command(AHEAD), 5, A)
    assert offer(commands, again, T0) == AHEAD
    assert offer(commands, again, T0) is None  # over a second link
    assert commands.refused["repeated"] == 1


def test_numbers_that_are_not_finite_reach_the_arm_which_stops(encode_command: Encode) -> None:
    found = offer(CommandInput(), sample(encode_command(Twist(math.nan, 0, 0)), 1, A), T0)
    assert found is not None
    assert math.isnan(found.vx)


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=200))
def test_any_bytes_are_taken_or_counted(data: bytes) -> None:
    commands = CommandInput()
    found = offer(commands, sample(data, 1, A), T0)
    assert (found is None) == (sum(commands.refused.values()) == 1)
