"""Command of an arm: granted by the arm, proved with every command, valid for a short time.

`CommandArbiter` is the arm's side, for the simulated arm and every driver; `Signer` is the side of
the commander. The arm grants its command through a service, to one commander at a time, together
with a secret. Every command carries a keyed hash made with that secret. Whoever reads the bus and
repeats, forges or renumbers commands is therefore not obeyed, and takes nothing from the owner.
Pure.

A command ends at its expiry, counted from the instant of its **decision** on the commander's
monotonic clock. If both run on one machine (see `clock_domain`), that clock is also the arm's.
Otherwise the arm maps it by the least delay seen: it cannot see a delay that all commands share,
but the commander can, as the arm echoes the commander's own instants.
"""

from __future__ import annotations

import hmac
import os
import platform
import secrets
import threading
from collections import Counter
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import numpy as np
import zenoh

from tactile_core.bus.messages import MSG, DecodeError, codec, header
from tactile_core.bus.services import Service, ServiceError, declare_service
from tactile_core.bus.topics import COMMAND, NAME, service_key
from tactile_core.types import (
    NS_PER_S,
    ArmLimits,
    Instant,
    RemoteClock,
    Twist,
    after,
    monotonic_now,
    record,
)

# Services through which every arm, simulated or real, grants its command.


def serve_claims(session: zenoh.Session, arm: str, arbiter: CommandArbiter) -> list[Service]:
    """Serve ``claim`` and ``release`` of the arm called ``arm``."""

    def claim(request: ClaimRequest) -> Grant:
        try:
            return arbiter.claim(request, monotonic_now())
        except NotGrantedError as error:
            raise ServiceError(
                f"arm {arm!r} is not to be had: {error}; stop that one, or name another --arm"
            ) from error

    def release(request: Signed) -> dict[str, str]:
        try:
            arbiter.release(request)
        except NotGrantedError as error:
            raise ServiceError(str(error)) from error
        return {"commander": arbiter.commander}

    return [
        declare_service(session, service_key(arm, "claim", "arm"), claim, ClaimRequest),
        declare_service(session, service_key(arm, "release", "arm"), release, Signed),
    ]


FRAME: Final = "cupboard"

TAKEOVER: Final = 0.5
"""Silence of a commander, in s, after which another may be granted; the arm stops long before."""

FIRST_COMMAND: Final = 2.0
"""Time in s allowed from the grant to the first command."""

LONGEST_EXPIRY: Final = 0.1
"""Longest expiry in s after the decision: the time the arm may take to stop."""

AHEAD: Final = 0.01
"""Tolerance in s for decisions in the future of this machine's clock."""

PROOF_BYTES: Final = 16
NO_PROOF: Final = np.zeros(PROOF_BYTES, np.uint8)

Refusal = Literal[
    "malformed",
    "foreign",
    "forged",
    "repeated",
    "late",
    "future",
    "bad_expiry",
    "wrong_frame",
    "not_planar",
]

REFUSALS: Final[tuple[Refusal, ...]] = (
    "malformed",
    "foreign",
    "forged",
    "repeated",
    "late",
    "future",
    "bad_expiry",
    "wrong_frame",
    "not_planar",
)
"""Why a command is not obeyed. ``foreign``: the sender does not command the arm. ``forged``: under
the commander's name without the right proof. ``repeated``: obeyed before, or older than one that
was. ``late``: older than its expiry on arrival. ``future``: decided after now."""


class NotGrantedError(Exception):
    """Claim or request refused; the text says why."""


class ClaimRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Request for the command.

    ``name``: name of the reach; ``clock``: commander's `clock_domain`.
    """

    name: str
    clock: str


class Grant(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Granted command. ``commander``: name given by the arm; ``key``: the secret, as hex digits.

    ``clock``: "same" if the arm uses the commander's own clock, otherwise "remote".
    """

    commander: str
    key: str
    clock: str


class Signed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Request with a proof that the commander made it; see `Signer.sign`.

    All fields are empty without a grant: such requests pass only while the arm has no commander.
    """

    commander: str = ""
    number: int = 0
    proof: str = ""


class LimitsRequest(Signed, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`ArmLimits`, signed. Raises ValueError for limits without effect."""

    v_max: float
    omega_max: float
    f_max: float
    m_max: float

    def __post_init__(self) -> None:
        """Reject invalid limits, as `ArmLimits` does."""
        _ = self.limits

    @property
    def limits(self) -> ArmLimits:
        """The limits without the signature."""
        return ArmLimits(self.v_max, self.omega_max, self.f_max, self.m_max)


@record
class Order:
    """A command that may be obeyed until ``expires``, on the arm's clock.

    ``decided`` is the instant on the commander's clock, echoed together with ``sequence``.
    """

    twist: Twist
    commander: str
    sequence: int
    decided: Instant
    expires: Instant


@cache
def clock_domain() -> str:
    """Identify the monotonic clock of this process: instants of equal domains can be compared."""
    parts = [platform.node()]
    with suppress(OSError):  # not Linux: use the machine's name alone
        parts = [Path("/proc/sys/kernel/random/boot_id").read_text().strip()]
        parts.append(os.readlink("/proc/self/ns/time"))  # containers may shift the clock
    return " ".join(parts)


def command_message(
    twist: Twist,
    decided: Instant,
    expiry: float,
    wall_ns: int,
    *,
    commander: str = "",
    sequence: int = 0,
) -> Any:
    """``ArmCommand`` without a proof; ``wall_ns``, the time of decision, goes into the header."""
    linear, angular = MSG.Vector3(twist.vx, twist.vy, 0.0), MSG.Vector3(0.0, 0.0, twist.omega)
    return MSG.ArmCommand(
        header=header(wall_ns, FRAME),
        twist=MSG.Twist(linear, angular),
        decided_ns=decided,
        sequence=sequence,
        expiry=expiry,
        commander=commander,
        proof=NO_PROOF,
    )


class Signer:
    """The commander's side of ``grant``: numbers and signs commands and requests."""

    def __init__(self, grant: Grant) -> None:
        self.commander = grant.commander
        self._key = bytes.fromhex(grant.key)
        self._sequence = 0
        self._number = 0

    def command(self, twist: Twist, decided: Instant, expiry: float, wall_ns: int) -> bytes:
        """Encode and sign the next command; CDR bytes."""
        self._sequence += 1
        message = command_message(
            twist, decided, expiry, wall_ns, commander=self.commander, sequence=self._sequence
        )
        data = codec().encode(COMMAND, message)[:-PROOF_BYTES]
        return data + _proof(self._key, data)

    def sign(self, service: str, **fields: object) -> dict[str, object]:
        """Sign a request to the arm's ``service``; returns the fields to be sent as JSON."""
        self._number += 1
        about = _signed_bytes(service, self.commander, self._number, fields)
        signed = {"commander": self.commander, "number": self._number}
        return fields | signed | {"proof": _proof(self._key, about).hex()}


class CommandArbiter:
    """The arm's side: grants the command to one at a time and checks every command.

    Every command is checked on arrival, in any thread, so that a flood from others cannot hide the
    commander's; `newest` returns the last valid one.
    """

    def __init__(self) -> None:
        self._codec = codec()
        self._lock = threading.Lock()
        self._commander = ""
        self._name = ""
        self._key = b""
        self._clock: RemoteClock | None = None  # None if it is this machine's clock
        self._reserved_until = Instant(0)  # nobody else is granted before
        self._last_sequence = 0  # sequence of the newest authentic command
        self._last_request = 0  # number of the newest granted request
        self._order: Order | None = None
        self._counts: Counter[str] = Counter()

    @property
    def commander(self) -> str:
        """Commander whose commands are obeyed; empty for none."""
        return self._commander

    @property
    def refused(self) -> dict[str, int]:
        """Commands refused so far, by reason; ``not_granted`` counts claims and requests."""
        return {reason: self._counts[reason] for reason in (*REFUSALS, "not_granted")}

    def claim(self, request: ClaimRequest, now: Instant) -> Grant:
        """Grant the command. Raises `NotGrantedError` while another commander is active."""
        with self._lock:
            if not NAME.fullmatch(request.name):
                self._counts["not_granted"] += 1
                raise NotGrantedError(f"{request.name[:80]!r} cannot be the name of a commander")
            if self._commander and now < self._reserved_until:
                self._counts["not_granted"] += 1
                raise NotGrantedError(f"commanded by another reachd (reach {self._name!r})")
            own = request.clock == clock_domain()
            key = secrets.token_bytes(32)
            self._commander = f"{request.name}-{secrets.token_hex(4)}"
            self._name, self._key = request.name, key
            self._clock = None if own else RemoteClock()
            self._reserved_until = after(now, FIRST_COMMAND)
            self._last_sequence = self._last_request = 0
            self._order = None
            return Grant(self._commander, key.hex(), "same" if own else "remote")

    def release(self, request: Signed) -> None:
        """Give the grant back.

        Raises `NotGrantedError` if the request is not from the commander.
        """
        with self._lock:
            if not self._commander:
                return
            self._verify("release", request, {})
            self._forget()

    def forget(self) -> None:
        """Revoke the grant; for the arm's own operator."""
        with self._lock:
            self._forget()

    def _forget(self) -> None:
        self._commander = self._name = ""
        self._key = b""
        self._order = None

    def authorise(self, service: str, request: Signed, now: Instant, **fields: object) -> None:
        """Check a request reserved for the commander; raises `NotGrantedError`.

        While the arm has no commander, or one that has long been silent, any request passes.
        """
        with self._lock:
            if self._commander and (request.commander or now < self._reserved_until):
                self._verify(service, request, fields)

    def receive(self, data: bytes, now: Instant) -> Refusal | None:
        """Check a command received at ``now``; returns and counts the reason if it is refused."""
        with self._lock:
            found = self._check(data, now)
            if isinstance(found, Order):
                self._order = found
                return None
            self._counts[found] += 1
            return found

    def newest(self, now: Instant) -> Order | None:
        """The newest command not returned before, if it is still valid."""
        with self._lock:
            order, self._order = self._order, None
            if order is not None and order.expires <= now:
                self._counts["late"] += 1
                return None
            return order

    def _check(self, data: bytes, now: Instant) -> Order | Refusal:
        try:
            message = self._codec.decode(COMMAND, data)
        except DecodeError:
            return "malformed"
        if not self._commander or message.commander != self._commander:
            return "foreign"
        head, proof = data[:-PROOF_BYTES], data[-PROOF_BYTES:]
        if not hmac.compare_digest(_proof(self._key, head), proof):
            return "forged"
        # From here on the command is authentic.
        sequence = int(message.sequence)
        if sequence <= self._last_sequence:
            return "repeated"
        self._last_sequence = sequence
        self._reserved_until = max(self._reserved_until, after(now, TAKEOVER))
        expiry = float(message.expiry)
        if not 0.0 < expiry <= LONGEST_EXPIRY:
            return "bad_expiry"
        stamp = Instant(int(message.decided_ns))
        decided = stamp if self._clock is None else self._clock.here(stamp, now)
        if decided > now + AHEAD * NS_PER_S:
            return "future"
        expires = after(decided, expiry)
        if expires <= now:
            return "late"
        if message.header.frame_id != FRAME:
            return "wrong_frame"
        linear, angular = message.twist.linear, message.twist.angular
        if any(part != 0.0 for part in (linear.z, angular.x, angular.y)):
            return "not_planar"
        twist = Twist(float(linear.x), float(linear.y), float(angular.z))
        return Order(twist, self._commander, sequence, stamp, expires)

    def _verify(self, service: str, request: Signed, fields: dict[str, object]) -> None:
        """Raise NotGrantedError unless ``request`` is new and the commander's; needs the lock."""
        about = _signed_bytes(service, request.commander, request.number, fields)
        good = hmac.compare_digest(_proof(self._key, about).hex().encode(), request.proof.encode())
        if request.commander != self._commander or not good or request.number <= self._last_request:
            self._counts["not_granted"] += 1
            raise NotGrantedError(
                f"{service} is for the arm's commander (reach {self._name!r}) while it has one"
            )
        self._last_request = request.number


def _proof(key: bytes, data: bytes) -> bytes:
    return hmac.digest(key, data, "sha256")[:PROOF_BYTES]


def _signed_bytes(service: str, commander: str, number: int, fields: dict[str, object]) -> bytes:
    plain = {k: float(v) if isinstance(v, int | float) else v for k, v in fields.items()}
    return msgspec.json.encode([service, commander, number, plain], order="sorted")


def limits_fields(limits: ArmLimits) -> dict[str, object]:
    """Fields of a `LimitsRequest` for ``limits``."""
    return {
        "v_max": limits.v_max,
        "omega_max": limits.omega_max,
        "f_max": limits.f_max,
        "m_max": limits.m_max,
    }
