"""The newest value of each input of control: who may publish it, and its age.

Ages are measured on this host's monotonic clock. Stamps are assumed to be of the same clock, unless
the settings say that the sender runs on another machine. A sender elsewhere that the settings do
not name gives stamps far from now, which the gate refuses. When in doubt, the arm stops.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto
from typing import Any, Generic, TypeVar

import zenoh

from reachd.interfaces import ArmState, Patch, Touch, Twist, Wrench, planar_patch
from tactile_core.bus.messages import DecodeError, codec
from tactile_core.bus.streams import BusSample, Latest, Tap, latest
from tactile_core.bus.topics import FEATURES, Topic
from tactile_core.geometry import Side
from tactile_core.types import Echo, Instant, RemoteClock, monotonic_now, seconds_between

T = TypeVar("T")

DUPLICATE_FOR = 1.0
"""s after the last sample of a second publisher until it counts as gone."""


class Verdict(Enum):
    """Judgement of a sample."""

    ACCEPTED = auto()
    REPEATED = auto()  # the last sample again, over a second link
    DUPLICATE = auto()  # from a second publisher, or one that pretends to be the first
    ANONYMOUS = auto()  # has no publisher's id, so it cannot be told from others


class SourcePin:
    """Pins an input to its first publisher for as long as that one sends.

    After ``takeover`` s of silence, when nothing moves on its data any more, the next publisher is
    accepted like a restart of the first.
    """

    def __init__(self, takeover: float) -> None:
        self._takeover = takeover
        self._source: bytes | None = None
        self._sequence = 0
        self._data = b""
        self._heard: Instant | None = None
        self._foreign: Instant | None = None

    @property
    def source(self) -> bytes | None:
        """Id of the publisher that the input is pinned to."""
        return self._source

    def judge(self, sample: BusSample, now: Instant) -> Verdict:
        """Judge a sample received at ``now``."""
        if sample.source is None or sample.sequence is None:
            return self._note_foreign(now) if self._live(now) else Verdict.ANONYMOUS
        if not self._live(now):
            # Any sequence number: one forged under the publisher's id must not lock it out.
            repeated = sample.source == self._source and sample.data == self._data
            if repeated and sample.sequence == self._sequence:
                return Verdict.REPEATED
            self._source = sample.source
        elif sample.source != self._source:
            return self._note_foreign(now)
        elif sample.sequence == self._sequence and sample.data == self._data:
            return Verdict.REPEATED
        elif sample.sequence <= self._sequence:
            return self._note_foreign(now)
        self._sequence, self._data, self._heard = sample.sequence, sample.data, now
        return Verdict.ACCEPTED

    def duplicated(self, now: Instant) -> bool:
        """Whether a second publisher was seen in the last `DUPLICATE_FOR` s."""
        return self._foreign is not None and seconds_between(self._foreign, now) < DUPLICATE_FOR

    def _live(self, now: Instant) -> bool:
        return self._heard is not None and seconds_between(self._heard, now) < self._takeover

    def _note_foreign(self, now: Instant) -> Verdict:
        self._foreign = now
        return Verdict.DUPLICATE


class Input(Generic[T]):
    """One input: its newest value, and counts of samples by what became of them. Pure.

    ``make`` turns a message, its captured and its received instant into the value, and may raise
    ValueError. ``remote``: the sender's monotonic clock is not this machine's.
    """

    def __init__(
        self,
        topic: Topic,
        make: Callable[[Any, Instant, Instant], T],
        takeover: float,
        *,
        remote: bool = False,
    ) -> None:
        self.value: T | None = None
        self.message: Any = None
        self.pin = SourcePin(takeover)
        self.counters = {"accepted": 0, "malformed": 0} | {
            verdict.name.lower(): 0 for verdict in Verdict
        }
        self._topic = topic
        self._make = make
        self._codec = codec()
        self._remote = remote
        self._clock = RemoteClock()
        self._clock_of: bytes | None = None

    def take(self, sample: BusSample, now: Instant) -> None:
        """Process a sample received at ``now``; samples that cannot be used are counted."""
        verdict = self.pin.judge(sample, now)
        if verdict is not Verdict.ACCEPTED:
            self.counters[verdict.name.lower()] += 1
            return
        try:
            message = self._codec.decode(self._topic, sample.data)
            value = self._make(message, self._captured(message, now), now)
        except (DecodeError, ValueError):
            self.counters["malformed"] += 1
            return
        self.value, self.message = value, message
        self.counters["accepted"] += 1

    def _captured(self, message: Any, now: Instant) -> Instant:
        stamp = int(message.captured_ns)
        if not self._remote:
            return Instant(stamp)
        if self._clock_of != self.pin.source:
            self._clock, self._clock_of = RemoteClock(), self.pin.source
        return self._clock.here(stamp, now)


MAX_PATCHES = 64
"""Patches in a message of features; tactiled sends no more."""


def make_touch(message: Any, captured: Instant, received: Instant) -> Touch:
    """Convert ``ContactFeatures`` for strategies.

    ValueError for an unknown side, for more than `MAX_PATCHES` patches and, where the features are
    valid, for a patch that is not finite.
    """
    force, torque = message.wrench.force, message.wrench.torque
    return Touch(
        captured=captured,
        received=received,
        valid=bool(message.valid),
        peak_force=float(message.peak_force),
        peak_side=Side(message.peak_side),
        peak_x=float(message.peak_position.x),
        peak_y=float(message.peak_position.y),
        total_force=float(message.normal_force),
        tip_force=float(message.tip_force),
        peak_force_bound=float(message.peak_force_bound),
        normal_force_bound=float(message.normal_force_bound),
        tip_force_bound=float(message.tip_force_bound),
        tip_contact_time=float(message.tip_contact_time),
        wrench=Wrench(float(force.x), float(force.y), float(torque.z)),
        patches=_patches(message) if message.valid else (),
    )


def _patches(message: Any) -> tuple[Patch, ...]:
    """The patches of a message that is valid, strongest first; ValueError."""
    if len(message.patches) > MAX_PATCHES:
        raise ValueError(f"{len(message.patches)} patches; at most {MAX_PATCHES} are sent")
    patches = []
    for felt in message.patches:
        patch = planar_patch(
            (float(felt.centroid.x), float(felt.centroid.y)),
            (float(felt.normal.x), float(felt.normal.y)),
            float(felt.normal_force),
            (float(felt.force.x), float(felt.force.y)),
            Side(felt.side),
            float(felt.normal_force_bound),
        )
        if not math.isfinite(patch.x + patch.y + patch.normal_force + patch.shear_force):
            raise ValueError("a patch is not finite")
        patches.append(patch)
    patches.sort(key=lambda patch: -patch.normal_force)
    return tuple(patches)


def make_arm_state(
    message: Any, captured: Instant, received: Instant, commander: str = ""
) -> ArmState:
    """Convert an ``ArmState`` message for strategies and gate.

    ``commander``: the name under which we command the arm.
    """
    linear, angular = message.twist.linear, message.twist.angular
    says = str(message.commander)
    echo = Echo(
        commander=says,
        sequence=int(message.command_sequence),
        decided=Instant(int(message.command_ns)),
        own=bool(commander) and says == commander,
    )
    return ArmState(
        captured=captured,
        received=received,
        x=float(message.x),
        y=float(message.y),
        heading=float(message.heading),
        twist=Twist(float(linear.x), float(linear.y), float(angular.z)),
        fx=float(message.wrench.force.x),
        fy=float(message.wrench.force.y),
        mz=float(message.wrench.torque.z),
        mode=str(message.mode),
        v_max=float(message.v_max),
        omega_max=float(message.omega_max),
        f_max=float(message.f_max),
        m_max=float(message.m_max),
        echo=echo,
    )


# The contact features of one board from the bus.


class TouchInput:
    """Newest features of ``board``; the control loop calls `newest` and `duplicated`."""

    def __init__(
        self, session: zenoh.Session, board: str, takeover: float, *, remote: bool = False
    ) -> None:
        key = FEATURES.key(board)
        self._input: Input[Touch] = Input(FEATURES, make_touch, takeover, remote=remote)
        self._watch = SourcePin(takeover)
        self._latest: Latest = latest(session, key)
        # The newest sample may hide another publisher's, so every sample is checked as well.
        self._tap = Tap(session, key, self._watch_features)

    def newest(self, now: Instant) -> Touch | None:
        """Newest features; None before the first."""
        sample = self._latest.newest()
        if sample is not None:
            self._input.take(sample, now)
        return self._input.value

    def duplicated(self, now: Instant) -> bool:
        """Whether a second publisher was seen in the last `DUPLICATE_FOR` s."""
        return self._input.pin.duplicated(now) or self._watch.duplicated(now)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the newest features are not valid."""
        message = self._input.message
        return () if message is None else tuple(message.reasons)

    @property
    def calibrated(self) -> bool:
        """Whether the newest features come from a calibrated board."""
        message = self._input.message
        return message is not None and bool(message.calibrated)

    def counters(self) -> dict[str, int]:
        """Counts of samples accepted, and of those not used, by reason."""
        return self._input.counters | {"oversized": self._latest.refused}

    def close(self) -> None:
        """Undeclare the subscriptions."""
        self._tap.close()
        self._latest.close()

    def _watch_features(self, sample: BusSample) -> None:
        self._watch.judge(sample, monotonic_now())
