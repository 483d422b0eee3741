"""Corrupted serial streams: every mutation of a frame, and those that only the CRC can detect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from sensor_proto import cobs
from sensor_proto.framing import SerialDecoder
from sensor_proto.packets import pack
from tactile_tools.dev.fuzzers.messages import Judge, key, random_messages

POOL = 3000
"""Different messages that are sent again and again; making them takes longer than corrupting
them."""

BATCH = 256
"""Frames corrupted at a time."""

DRAWS = 6
"""Random numbers drawn for each frame."""

LONGEST_RUN = 32
"""Longest run of bytes that a burst, a deletion or a blank covers."""

Draw = list[int]


def _flip(data: bytes, r: Draw) -> bytes:
    out = bytearray(data)
    for draw in r[: 1 + r[5] % 4]:
        out[(draw >> 3) % len(out)] ^= 1 << (draw & 7)
    return bytes(out)


def _burst(data: bytes, r: Draw) -> bytes:
    """Change a run: both of its ends differ, what is between them may."""
    start = r[0] % len(data)
    run = bytearray(data[start : start + 1 + r[1] % LONGEST_RUN])
    noise = (r[2] << 62 | r[3] << 31 | r[4]).to_bytes(24, "little")
    for i in range(len(run)):
        run[i] ^= noise[i % 12]
    run[0] ^= (noise[0] ^ 1) if run[0] == data[start] else 0
    return data[:start] + bytes(run) + data[start + len(run) :]


def _truncate(data: bytes, r: Draw) -> bytes:
    return data[: r[0] % len(data)]


def _delete(data: bytes, r: Draw) -> bytes:
    start = r[0] % len(data)
    return data[:start] + data[start + 1 + r[1] % LONGEST_RUN :]


def _insert(data: bytes, r: Draw) -> bytes:
    start = r[0] % (len(data) + 1)
    noise = (r[2] << 62 | r[3] << 31 | r[4]).to_bytes(12, "little")
    return data[:start] + noise[: 1 + r[1] % 12] + data[start:]


def _blank(data: bytes, r: Draw) -> bytes:
    start, run = r[0] % len(data), 1 + r[1] % LONGEST_RUN
    filler = b"\0" if r[2] & 1 else b"\xff"
    return data[:start] + filler * min(run, len(data) - start) + data[start + run :]


_ON_WIRE: dict[str, Callable[[bytes, Draw], bytes]] = {
    "flip": _flip,
    "burst": _burst,
    "truncate": _truncate,
    "delete": _delete,
    "insert": _insert,
    "blank": _blank,
}
"""Mutations of the frame as it is on the wire, with its final zero."""

_INSIDE = ("flip_inside", "burst_inside", "graft_inside", "noise_inside")
"""Mutations of the packet, which is then encoded again: framing notices nothing."""

_WHOLE = ("splice", "noise", "drop", "reorder", "duplicate", "intact")
KINDS = (*_ON_WIRE, *_INSIDE, *_WHOLE)
_HARMLESS = frozenset({"reorder", "duplicate", "intact"})


class SerialFuzzer:
    """One line with its decoder; `run` may be called repeatedly."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._pool = []
        for message in random_messages(rng, POOL):
            raw = pack(message)
            self._pool.append((key(message, 0), raw, cobs.encode(raw) + b"\0"))
        self._decoder = SerialDecoder()
        self.judge = Judge()
        self.kinds: Counter[str] = Counter()
        self.touched = self.glued = 0

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the decoder."""
        return self._decoder.counters

    def run(self) -> int:
        """Send one batch. Returns how many frames were corrupted."""
        rng = self._rng
        chosen = rng.permutation(POOL)[: BATCH + 1].tolist()
        kinds = rng.integers(0, len(KINDS), BATCH).tolist()
        draws = rng.integers(0, 1 << 31, (BATCH, DRAWS)).tolist()
        before = self.touched
        wire: list[bytes] = []
        at = 0
        while at < BATCH:
            at += self._one(KINDS[kinds[at]], chosen[at : at + 2], draws[at], wire)
        self._feed(b"".join(wire))
        return self.touched - before

    def finish(self) -> None:
        """End the last frame, so that everything is judged."""
        self._feed(b"\0")

    def _feed(self, data: bytes) -> None:
        at = 0
        sizes = self._rng.integers(1, 4096, 64).tolist()
        while at < len(data):
            size = sizes[at % len(sizes)]
            self.judge.receive(self._decoder.feed(data[at : at + size]))
            at += size

    def _one(self, kind: str, chosen: list[int], r: Draw, wire: list[bytes]) -> int:
        """Append the mutated frame (for some kinds also the next). Returns how many were used."""
        name, raw, frame = self._pool[chosen[0]]
        other_name, other_raw, other = self._pool[chosen[1]]
        self.kinds[kind] += 1
        self.judge.send(name)
        if kind in _HARMLESS:
            if kind == "intact":
                wire.append(frame)
                return 1
            self.judge.send(name if kind == "duplicate" else other_name)
            wire += (frame, frame) if kind == "duplicate" else (other, frame)
            return 1 if kind == "duplicate" else 2
        used = 1
        if kind in _ON_WIRE:
            corrupted = _ON_WIRE[kind](frame, r)
        elif kind in _INSIDE:
            corrupted = cobs.encode(self._inside(kind, raw, other_raw, r)) + b"\0"
        elif kind == "splice":
            self.judge.send(other_name)
            self.touched += 1
            used = 2
            corrupted = frame[: r[0] % len(frame)] + other[r[1] % len(other) :]
        else:
            corrupted = self._rng.bytes(len(frame)) if kind == "noise" else b""
        if corrupted == frame:
            wire.append(frame)
            return used
        self.touched += 1
        # A frame without its end also destroys the next one.
        self.glued += bool(corrupted) and corrupted[-1] != 0
        wire.append(corrupted)
        return used

    def _inside(self, kind: str, raw: bytes, other: bytes, r: Draw) -> bytes:
        if kind == "flip_inside":
            return _flip(raw, r)
        if kind == "burst_inside":
            return _burst(raw, r)
        if kind == "graft_inside":
            # Keep the header, so that length and type are right, and continue with the other.
            cut = 4 + r[0] % (len(raw) - 4)
            tail = other[-(len(raw) - cut) :]
            grafted = raw[:cut] + tail.rjust(len(raw) - cut, b"\0")
            # If the two differ only in the tail, the graft is the other message, intact.
            return _flip(grafted, r) if grafted == other else grafted
        return raw[:4] + self._rng.bytes(len(raw) - 4)
