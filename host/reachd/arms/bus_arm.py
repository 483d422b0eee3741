"""An arm behind the topics ``arm/<name>/...``: the simulated one, or any driver that speaks them.

Commands are ``TwistStamped`` at ``cmd_vel``. They carry no expiry: the arm's side ends each by
itself within 0.1 s of its receipt.
"""

from __future__ import annotations

from typing import Any

import msgspec
import zenoh

from reachd.arms.base import ArmError
from reachd.snapshot import Input, SourcePin, make_arm_state
from tactile_bus.arm_types import ArmLimits, ArmState, Twist
from tactile_bus.instant import Instant, WallClock, monotonic_now, seconds_between
from tactile_bus.messages import MSG, codec, header
from tactile_bus.services import ServiceError, call
from tactile_bus.streams import (
    BusSample,
    Latest,
    Publisher,
    Tap,
    declare_publisher,
    latest,
)
from tactile_bus.topics import ARM_STATE, COMMAND, service_key

FRAME = "cupboard"

LIMITS_TIMEOUT = 1.0
"""s for the arm's answer. It is asked while an operator waits, whose request dies in 2 s."""

COMMANDER_GONE = 1.0
"""s after the last command of somebody else until they are taken to be gone."""


def command_message(twist: Twist, wall_ns: int) -> Any:
    """``TwistStamped`` in ``cupboard``, stamped in wall-clock ns."""
    linear, angular = MSG.Vector3(twist.vx, twist.vy, 0.0), MSG.Vector3(0.0, 0.0, twist.omega)
    return MSG.TwistStamped(header(wall_ns, FRAME), MSG.Twist(linear, angular))


class BusArm:
    """See `reachd.arms.base.Arm`. ``takeover``: s of silence after which another sender is heeded.

    ``remote``: the arm's driver runs on another machine.
    """

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        wall: WallClock,
        takeover: float,
        *,
        remote: bool = False,
    ) -> None:
        self.name = name
        self._session = session
        self._wall = wall
        self._codec = codec()
        self._input: Input[ArmState] = Input(ARM_STATE, make_arm_state, takeover, remote=remote)
        self._watch = SourcePin(takeover)
        self._rival: Instant | None = None
        self._latest: Latest | None = None
        self._publisher: Publisher | None = None
        self._taps: list[Tap] = []

    def open(self) -> None:
        """Subscribe and publish; whether an arm is there shows in its state."""
        state_key, command_key = ARM_STATE.key(self.name), COMMAND.key(self.name)
        self._latest = latest(self._session, state_key)
        # The newest sample may hide another publisher's, so all of them are watched beside it.
        self._taps = [
            Tap(self._session, state_key, self._watch_state),
            Tap(self._session, command_key, self._watch_commands, remote_only=True),
        ]
        self._publisher = declare_publisher(self._session, COMMAND, self.name)

    def state(self, now: Instant) -> ArmState | None:
        """Newest state, None before the first."""
        sample = None if self._latest is None else self._latest.newest()
        if sample is not None:
            self._input.take(sample, now)
        return self._input.value

    def command(self, twist: Twist, expiry: float, now: Instant) -> None:  # noqa: ARG002 - `Arm` gives it
        """Publish ``twist``; its expiry is the arm's own. `ArmError` when the bus is closed."""
        if self._publisher is not None:
            wall_ns = self._wall.wall_ns(now)
            message = command_message(twist, wall_ns)
            try:
                self._publisher.put(self._codec.encode(COMMAND, message), wall_ns)
            except zenoh.ZError as error:
                raise ArmError(f"arm {self.name!r} cannot be commanded: {error}") from error

    def duplicated(self, now: Instant) -> bool:
        """Whether a second sender of states, or of commands, was heard of late."""
        rival = self._rival
        return (
            self._input.pin.duplicated(now)
            or self._watch.duplicated(now)
            or (rival is not None and seconds_between(rival, now) < COMMANDER_GONE)
        )

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Ask the arm's ``limits`` service."""
        key = service_key(self.name, "limits", "arm")
        try:
            reply = call(self._session, key, limits, LIMITS_TIMEOUT)
            return msgspec.convert(reply, ArmLimits)
        except ServiceError as error:
            raise ArmError(f"arm {self.name!r} does not take limits: {error}") from error
        except msgspec.ValidationError as error:
            raise ArmError(f"arm {self.name!r} confirms no limits: {error}") from error

    def counters(self) -> dict[str, int]:
        """States received, and what was not used, by reason."""
        refused = 0 if self._latest is None else self._latest.refused
        return self._input.counters | {"oversized": refused}

    def close(self) -> None:
        """Take subscriptions and publisher back."""
        for tap in self._taps:
            tap.close()
        self._taps.clear()
        if self._latest is not None:
            self._latest.close()
            self._latest = None
        if self._publisher is not None:
            self._publisher.close()
            self._publisher = None

    def _watch_state(self, sample: BusSample) -> None:
        self._watch.judge(sample, monotonic_now())

    def _watch_commands(self, _: BusSample) -> None:
        self._rival = monotonic_now()
