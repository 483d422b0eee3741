"""Corrupted CAN buses: frames of several boards interleaved, lost, moved, changed and grafted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import replace

import numpy as np

from sensor_proto.can_transfers import CanDecoder, CanEncoder, CanFrame
from sensor_proto.packets import Message, Samples
from tactile_tools.dev.fuzzers.messages import Judge, key, random_messages

POOL = 600
"""Messages per board that are sent again and again."""

BOARDS = (0, 5, 77, 126)
FD_BOARDS = frozenset({5, 126})
TRANSFERS = 32
"""Transfers per board and batch."""

MAX_TAXELS = 32
"""Most taxels of a message: longer samples take 130 frames of CAN 2.0B and test nothing new."""

KINDS = (
    "flip_data",
    "flip_tail",
    "flip_identifier",
    "cut",
    "lose_frame",
    "lose_run",
    "delay_frame",
    "swap",
    "repeat_later",
    "graft",
    "noise",
    "duplicate",
    "intact",
)
_HARMLESS = frozenset({"duplicate", "intact"})


class CanFuzzer:
    """One bus with its decoder; `run` may be called repeatedly."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._encoders = {board: CanEncoder(board, board in FD_BOARDS) for board in BOARDS}
        pool = random_messages(rng, 2 * POOL)
        small = [m for m in pool if not isinstance(m, Samples) or len(m.status) <= MAX_TAXELS]
        self._pool: list[tuple[Message, dict[int, Hashable]]] = [
            (message, {board: key(message, board) for board in BOARDS}) for message in small[:POOL]
        ]
        self._decoder = CanDecoder()
        self.judge = Judge()
        self.kinds: Counter[str] = Counter()
        self.touched = self.strays = 0

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the decoder."""
        return self._decoder.counters

    def run(self) -> int:
        """Send one batch. Returns how many transfers were corrupted."""
        before = self.touched
        queues: list[list[CanFrame]] = []
        for board in BOARDS:
            queues.append(self._corrupt(*self._transfers(board)))
        frames = self._interleave(queues)
        self.judge.receive(self._decoder.feed(frames[: len(frames) // 2]))
        self.judge.receive(self._decoder.feed(frames[len(frames) // 2 :]))
        return self.touched - before

    def finish(self) -> None:
        """Do nothing: on a bus nothing waits, and an unfinished transfer was corrupted."""

    def _transfers(self, board: int) -> tuple[list[Hashable], list[list[CanFrame]]]:
        """Keys and frames of the messages that a board sends in one batch."""
        chosen = [self._pool[i] for i in self._rng.permutation(len(self._pool))[:TRANSFERS]]
        names = [keys[board] for _, keys in chosen]
        for name in names:
            self.judge.send(name)
        return names, [list(self._encoders[board].encode(message)) for message, _ in chosen]

    def _corrupt(self, names: list[Hashable], transfers: list[list[CanFrame]]) -> list[CanFrame]:
        """Frames of one board, with each transfer mutated."""
        out: list[CanFrame] = []
        delayed: list[CanFrame] = []
        kinds = self._rng.integers(0, len(KINDS), len(transfers)).tolist()
        draws = self._rng.integers(0, 1 << 31, (len(transfers), 4)).tolist()
        for name, frames, number, r in zip(names, transfers, kinds, draws, strict=True):
            kind = KINDS[number]
            self.kinds[kind] += 1
            corrupted, later = self._one(kind, list(frames), transfers, r)
            if kind == "repeat_later" and len(frames) == 1:
                # The whole message was sent twice; a later copy cannot be told from a new one.
                self.judge.send(name)
            if corrupted != frames and kind not in _HARMLESS:
                self.touched += 1
            out += corrupted
            # Delayed frames appear in the middle of whatever is sent two transfers later.
            if len(delayed) > 2 or (delayed and r[3] % 3 == 0):
                # Not between a frame and its repetition, which would then be a separate message.
                at = len(out) - (0 if kind == "duplicate" else r[3] % (len(corrupted) + 1))
                out[at:at] = delayed
                self.strays += len(delayed)
                delayed = []
            delayed += later
        self.strays += len(delayed)
        return out + delayed

    def _one(
        self, kind: str, frames: list[CanFrame], others: list[list[CanFrame]], r: list[int]
    ) -> tuple[list[CanFrame], list[CanFrame]]:
        """Frames of a mutated transfer to send now, and frames of it to send later."""
        at = r[0] % len(frames)
        frame = frames[at]
        later: list[CanFrame] = []
        match kind:
            case "flip_data":
                frames[at] = replace(frame, data=_flip(frame.data, r[1]))
            case "flip_tail":
                tail = frame.data[-1] ^ (1 + r[1] % 255)
                frames[at] = replace(frame, data=frame.data[:-1] + bytes([tail]))
            case "flip_identifier":
                frames[at] = replace(frame, identifier=frame.identifier ^ 1 << r[1] % 29)
                self.strays += 1
            case "cut":
                frames[at] = replace(frame, data=frame.data[: r[1] % len(frame.data)])
            case "lose_frame":
                del frames[at]
            case "lose_run":
                del frames[at : at + 1 + r[1] % 33]
            case "delay_frame":
                later = [frames.pop(at)]
            case "swap":
                next_one = (at + 1) % len(frames)
                frames[at], frames[next_one] = frames[next_one], frames[at]
            case "repeat_later":
                frames.insert((at + 2 + r[1] % 5) % (len(frames) + 1), frame)
            case "graft":
                frames = _graft(frames, others[r[1] % len(others)], at)
            case "noise":
                frames[at] = replace(frame, data=self._rng.bytes(len(frame.data)))
            case "duplicate":
                frames.insert(at, frame)
        return frames, later

    def _interleave(self, queues: list[list[CanFrame]]) -> list[CanFrame]:
        """All frames in random order, but those of one board in their own order."""
        owners = np.repeat(np.arange(len(queues)), [len(q) for q in queues])
        sources = [iter(q) for q in queues]
        return [next(sources[owner]) for owner in self._rng.permutation(owners).tolist()]


def _flip(data: bytes, draw: int) -> bytes:
    out = bytearray(data)
    out[(draw >> 3) % len(out)] ^= 1 << (draw & 7)
    return bytes(out)


def _graft(frames: list[CanFrame], other: list[CanFrame], at: int) -> list[CanFrame]:
    """Continue with the data of another transfer under our own identifier and tails.

    This is what 32 lost transfers, or a board that was reset, look like: only the CRC shows that
    two transfers were mixed.
    """
    joined = frames[:at]
    for ours, theirs in zip(frames[at:], other[at:], strict=False):
        tail = ours.data[-1:]
        same = len(theirs.data) == len(ours.data)
        joined.append(replace(ours, data=theirs.data[:-1] + tail) if same else ours)
    if [f.data[:-1] for f in joined] == [f.data[:-1] for f in other]:
        # If the two differ only in the graft, the result is the other message, intact.
        return frames[:-1]
    return joined
