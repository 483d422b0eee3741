"""An arm on the topics ``arm/<name>/...``: the simulated one, or any driver that serves them.

Commands are ``ArmCommand`` at ``cmd_vel``, each with its instant, number, expiry, and proof that it
comes from the commander to whom the arm granted its command (`tactile_core.bus.commanding`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Any

import msgspec
import zenoh

from reachd.arms.base import ArmError
from reachd.inputs import Input, SourcePin, make_arm_state
from tactile_core.bus.commanding import ClaimRequest, Grant, Signer, clock_domain, limits_fields
from tactile_core.bus.services import NoAnswerError, ServiceError, call
from tactile_core.bus.streams import (
    BusSample,
    Latest,
    Publisher,
    Tap,
    declare_publisher,
    latest,
)
from tactile_core.bus.topics import ARM_STATE, COMMAND, service_key
from tactile_core.types import (
    ArmLimits,
    ArmState,
    Instant,
    Twist,
    WallClock,
    monotonic_now,
    seconds_between,
)

log = logging.getLogger(__name__)

ANSWER_TIMEOUT = 1.0
"""s for the arm's answer, while an operator waits, whose request times out after 2 s."""

CLAIM_AGAIN = 0.1
"""s between two requests for the arm's command."""

GRANT_SHOWN = 0.5
"""s after a grant by which the arm's state must show it; otherwise it is requested again."""

DENIED_FOR = 1.0
"""s of refusals after which the arm counts as another commander's; one that was killed is forgotten
sooner."""

RELEASE_TIMEOUT = 0.2
"""s for the arm to take its command back; if it does not, silence ends the grant."""

RIVAL_GONE = 1.0
"""s after the last command of another sender until it counts as gone."""


class BusArm:
    """Implements `reachd.arms.base.Arm`. ``takeover``: s of silence until another publisher of the
    state is accepted.

    ``reach``: our name as commander. ``remote``: the arm's driver runs on another machine.
    """

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        wall: WallClock,
        takeover: float,
        *,
        reach: str = "reach",
        remote: bool = False,
    ) -> None:
        self.name = name
        self._session = session
        self._wall = wall
        self._reach = reach
        self._input: Input[ArmState] = Input(ARM_STATE, self._make_state, takeover, remote=remote)
        self._watch = SourcePin(takeover)
        self._rival: Instant | None = None
        self._rivals = 0
        self._latest: Latest | None = None
        self._publisher: Publisher | None = None
        self._taps: list[Tap] = []
        self._signer: Signer | None = None
        self._granted_at = Instant(0)
        self._signing = threading.Lock()  # requests come from several threads
        self._denied: str | None = None
        self._denied_since: Instant | None = None
        self._closing = threading.Event()
        self._claimer = threading.Thread(target=self._claim, name="claim", daemon=True)

    def open(self) -> None:
        """Subscribe, declare the publisher, and begin to request the arm, present or not."""
        state_key, command_key = ARM_STATE.key(self.name), COMMAND.key(self.name)
        self._latest = latest(self._session, state_key)
        # The newest sample may hide another publisher's, so every sample is checked as well.
        self._taps = [
            Tap(self._session, state_key, self._watch_state),
            Tap(self._session, command_key, self._watch_commands, remote_only=True),
        ]
        self._publisher = declare_publisher(self._session, COMMAND, self.name)
        self._claimer.start()

    def state(self, now: Instant) -> ArmState | None:
        """Newest state; None before the first."""
        sample = None if self._latest is None else self._latest.newest()
        if sample is not None:
            self._input.take(sample, now)
        return self._input.value

    def command(self, twist: Twist, expiry: float, now: Instant) -> bytes:
        """Publish ``twist``, if the arm has granted its command. `ArmError` on a closed bus."""
        signer, publisher = self._signer, self._publisher
        if signer is None or publisher is None:
            return b""
        wall_ns = self._wall.wall_ns(now)
        data = signer.command(twist, now, expiry, wall_ns)
        try:
            publisher.put(data, wall_ns)
        except zenoh.ZError as error:
            raise ArmError(f"arm {self.name!r} cannot be commanded: {error}") from error
        return data

    @property
    def denied(self) -> str | None:
        """Why the arm does not grant its command, once it has refused for `DENIED_FOR`."""
        since = self._denied_since
        if since is None or seconds_between(since, monotonic_now()) < DENIED_FOR:
            return None
        return self._denied

    def duplicated(self, now: Instant) -> bool:
        """Whether a second publisher of states was seen lately."""
        return self._input.pin.duplicated(now) or self._watch.duplicated(now)

    def rivalled(self, now: Instant) -> bool:
        """Whether commands of another sender were seen lately."""
        rival = self._rival
        return rival is not None and seconds_between(rival, now) < RIVAL_GONE

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Call the arm's ``limits`` service."""
        reply = self._call_service("limits", limits_fields(limits))
        try:
            return msgspec.convert(reply, ArmLimits)
        except msgspec.ValidationError as error:
            raise ArmError(f"arm {self.name!r} confirms no limits: {error}") from error

    def request_clear(self) -> str:
        """Call the arm's ``clear`` service; returns its mode."""
        reply = self._call_service("clear")
        return str(reply.get("mode", "")) if isinstance(reply, dict) else ""

    def counters(self) -> dict[str, int]:
        """Counts of states accepted and not used, by reason, and of others' commands."""
        refused = 0 if self._latest is None else self._latest.refused
        return self._input.counters | {"oversized": refused, "rival_commands": self._rivals}

    def close(self) -> None:
        """Release the arm's command, and undeclare subscriptions and publisher."""
        self._closing.set()
        if self._signer is not None:
            with suppress(ArmError):
                self._call_service("release", timeout=RELEASE_TIMEOUT)
            self._signer = None
        for tap in self._taps:
            tap.close()
        self._taps.clear()
        if self._latest is not None:
            self._latest.close()
            self._latest = None
        if self._publisher is not None:
            self._publisher.close()
            self._publisher = None

    def _call_service(
        self,
        service: str,
        fields: Mapping[str, object] = MappingProxyType({}),
        timeout: float = ANSWER_TIMEOUT,
    ) -> Any:
        """Call a service that the arm reserves for its commander; `ArmError` when it fails."""
        signer = self._signer
        if signer is None:
            raise ArmError(f"arm {self.name!r} has not granted its command: {self._denial()}")
        with self._signing:
            request = signer.sign(service, **fields)
        try:
            return call(self._session, service_key(self.name, service, "arm"), request, timeout)
        except ServiceError as error:
            raise ArmError(f"arm {self.name!r} refuses {service}: {error}") from error

    def _denial(self) -> str:
        return self._denied or "is its driver running, and is it of this version?"

    def _make_state(self, message: Any, captured: Instant, received: Instant) -> ArmState:
        signer = self._signer
        own = "" if signer is None else signer.commander
        return make_arm_state(message, captured, received, own)

    def _watch_state(self, sample: BusSample) -> None:
        self._watch.judge(sample, monotonic_now())

    def _watch_commands(self, _: BusSample) -> None:
        self._rival = monotonic_now()
        self._rivals += 1

    # Everything below runs on the claimer's thread.

    def _claim(self) -> None:
        """Request the arm's command whenever we do not have it."""
        while not self._closing.wait(CLAIM_AGAIN):
            if self._signer is not None and self._is_granted():
                continue
            try:
                self._request_grant()
            except (ServiceError, zenoh.ZError) as error:
                if isinstance(error, ServiceError) and not isinstance(error, NoAnswerError):
                    self._denied = str(error)
                    self._denied_since = self._denied_since or monotonic_now()
                log.debug("arm %s: %s", self.name, error)

    def _is_granted(self) -> bool:
        """Whether the arm's state names us as commander; after a grant it has time to show it."""
        state, now = self._input.value, monotonic_now()
        if seconds_between(self._granted_at, now) < GRANT_SHOWN or state is None:
            return True
        return state.echo is not None and state.echo.own

    def _request_grant(self) -> None:
        request = ClaimRequest(self._reach, clock_domain())
        key = service_key(self.name, "claim", "arm")
        try:
            grant = msgspec.convert(call(self._session, key, request, ANSWER_TIMEOUT), Grant)
            signer = Signer(grant)
        except (msgspec.ValidationError, ValueError) as error:
            text = f"arm {self.name!r} sends a grant that cannot be read: {error}"
            raise ServiceError(text) from error
        self._granted_at = monotonic_now()
        self._signer = signer
        self._denied = self._denied_since = None
        log.info("arm %s granted its command to %s", self.name, grant.commander)
