"""Hostile board in front of tactiled's own links and pipeline, on virtual time.

Its frames are well formed and their CRCs are right, so that everything behind the decoder has to
handle what they contain: any values, types, lengths and orders. After each block an honest board is
plugged in, and must be in service within `RECOVERY_S`.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sensor_proto import cobs
from sensor_proto.anyskin import encode_anyskin
from sensor_proto.can_transfers import CanDecoder, CanFrame, identifier, segment
from sensor_proto.crc import crc32c
from sensor_proto.packets import FloatSamples, MessageType, pack
from sim_device.board.anyskin import AnySkinBoard
from sim_device.board.catalogue import build_skin, factory_calibration, identity
from sim_device.board.firmware import CanBoard, SerialBoard
from tactile_core.bus.messages import MAX_PAYLOAD, codec
from tactile_core.bus.topics import FEATURES, Topic
from tactile_core.types import NS_PER_S, Instant, WallClock
from tactile_tools.dev.fuzzers.messages import random_messages
from tactiled.blocks import Chunk
from tactiled.board_session import BoardSession
from tactiled.boards.events import Identity, Refusal
from tactiled.boards.line import bus_names, make_line
from tactiled.calibration_store import CalibrationStore
from tactiled.port import Port
from tactiled.reader import Inbox, PortLost, PortOpened, Wake
from tactiled.rerun import RecordedSource
from tactiled.sensing.settings import PipelineSettings
from tactiled.transports.base import Medium

Kind = Literal["serial", "can", "floats"]

STEP_NS = NS_PER_S // 200
"""Virtual time of one step: 200 a second."""

POWER_ON = Instant(500 * NS_PER_S)
WALL = WallClock(1_700_000_000 * NS_PER_S)
HONEST_S = 1.0
"""Seconds of an honest stream before the first mutation: an identity, a tare, a clock."""

RECOVERY_S = 6.0
"""Seconds until an honest board must be in service after a block: greeting, clock, tare."""

MUTATED_SHARE = 0.5
"""Share of the frames that are mutated; the others keep the links and the pipeline busy."""

EXTREMES = (0x00, 0xFF, 0x7F, 0x80, 0x01)
FLOATS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-40, -0.0, 0.0, 65535.0, -32768.0, 1e9)
NODE = 5
MAX_BOARDS = 128
"""Most boards of a port: the addresses of a CAN bus. A larger table grows without bound."""


class PipelineFailure(Exception):  # noqa: N818 - a finding of the fuzzer
    """Something behind the decoder failed; the text says what."""


class Sink:
    """`tactiled.publisher.Sink` that encodes everything as the bus would, and checks features."""

    def __init__(self) -> None:
        self.wall = WALL
        self.recorder: Any = None
        self.moment = POWER_ON
        self.sent = 0
        self.features = 0
        self.valid = 0
        self.texts = 0
        self.oversized = 0

    def now(self) -> Instant:
        """Virtual time."""
        return self.moment

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:  # noqa: ARG002 - as the daemon's sink
        """Encode and check; `PipelineFailure` for a force that is valid and not finite."""
        data = codec().encode(topic, message)
        self.sent += 1
        self.oversized += len(data) > MAX_PAYLOAD
        if topic is FEATURES:
            self.features += 1
            self.valid += bool(message.valid)
            if message.valid and not math.isfinite(message.peak_force):
                raise PipelineFailure(f"valid features with a force of {message.peak_force} N")

    def announce(self, *_: Any, **__: Any) -> None:
        """Count a line of the daemon's own log."""
        self.texts += 1

    def firmware_text(self, *_: Any, **__: Any) -> None:
        """Count a text of the board's."""
        self.texts += 1


class Source(RecordedSource):
    """Port whose writes reach the board."""

    def __init__(self, medium: Medium) -> None:
        super().__init__("fuzz", medium)
        self.written: list[Any] = []

    def write(self, data: Any) -> None:
        """Keep what the host sends, for the board."""
        self.written.append(data)


class PipelineFuzzer:
    """One port with a hostile board. ``mutated``: frames so far; `PipelineFailure` from `run`."""

    def __init__(self, kind: Kind, rng: np.random.Generator) -> None:
        self.kind = kind
        self.mutated = 0
        self.kinds: Counter[str] = Counter()
        self.sink = Sink()
        self.now = POWER_ON
        self._rng = rng
        self._seed = 3
        medium = Medium.CAN if kind == "can" else Medium.SERIAL
        calibrations = []
        if kind != "floats":
            calibrations.append(factory_calibration("finger", self._seed))
        store = CalibrationStore((), strict=False)
        for calibration in calibrations:
            store.add(Path(calibration.serial_number), calibration)
        self._source = Source(medium)
        self._inbox = Inbox(Wake(), limit=1024)
        line = make_line(
            "fuzz",
            lambda node, who: self._admit(node, who),
            medium,
            kind="anyskin" if kind == "floats" else "auto",
            rate=None,
            baud=115_200,
            fd=kind == "can",
            nodes=None,
            listen_only=False,
        )
        self.port = Port(
            "fuzz",
            line,
            self._source,
            self._inbox,
            lambda nodes, late: bus_names("fuzz", {}, nodes, late),
            lambda _port, _node, name: BoardSession(name, self.sink, store, PipelineSettings()),
            True,
            None,
        )
        if kind != "can":
            self.port.add_board(0, "fuzz")
        self._pool = [(m, pack(m, NODE)) for m in random_messages(rng, 300)]
        self._transfers: Counter[int] = Counter()
        self._texts = 0
        self._board: Any = None
        self._plug()

    def _admit(self, node: int, who: Identity) -> Refusal | None:
        return self.port.admit(node, who)

    def _plug(self) -> None:
        """Connect an honest board, from power-on."""
        if self._board is not None:
            self._inbox.put(PortLost("pulled out"))
        if self.kind == "floats":
            self._board = AnySkinBoard(build_skin("anyskin", self._seed))
        elif self.kind == "can":
            skin, who = build_skin("finger", self._seed), identity("finger", self._seed)
            self._board = CanBoard(skin, who, node=NODE, fd=True)
        else:
            self._board = SerialBoard(
                build_skin("finger", self._seed), identity("finger", self._seed)
            )
        self._inbox.put(PortOpened("", 0.0))

    def run(self, mutations: int) -> None:
        """Run an honest second, ``mutations`` hostile frames, and an honest board again."""
        self._run(HONEST_S, hostile=False)
        wanted = self.mutated + mutations
        while self.mutated < wanted:
            self._step(hostile=True)
        self._recover()
        self._check_bounds()

    def _run(self, seconds: float, *, hostile: bool) -> None:
        for _ in range(round(seconds * NS_PER_S / STEP_NS)):
            self._step(hostile=hostile)

    def _recover(self) -> None:
        self._plug()
        for _ in range(round(RECOVERY_S)):
            before = self.sink.features
            self._run(1.0, hostile=False)
            served = [s for s in self.port.boards.values() if s.state == "streaming"]
            if served and self.sink.features > before:
                return
        states = {node: board.state for node, board in self.port.boards.items()}
        raise PipelineFailure(f"no honest board in service after {RECOVERY_S:g} s: {states}")

    def _check_bounds(self) -> None:
        if len(self.port.boards) > MAX_BOARDS:
            raise PipelineFailure(f"{len(self.port.boards)} boards on one port")

    def _step(self, *, hostile: bool) -> None:
        self.now = self.sink.moment = Instant(self.now + STEP_NS)
        for payload in self._source.written:
            self._board.receive(payload, self.now)
        self._source.written.clear()
        payload = self._board.tick(self.now)
        if hostile:
            payload = self._corrupt(payload)
        if payload:
            self._inbox.put(Chunk(self.now, payload))
        self.port.pump(Instant(self.now + 100_003))
        if self.now % NS_PER_S < STEP_NS:
            for board in list(self.port.boards.values()):
                board.each_second(self.now)

    # Mutations of a frame

    def _corrupt(self, payload: Any) -> Any:
        if self.kind == "floats":
            return self._corrupt_floats(payload)
        raws = list(self._raws(payload))
        out: list[bytes] = []
        for raw in raws:
            if self._rng.random() >= MUTATED_SHARE:
                out.append(raw)
                continue
            self.mutated += 1
            out += self._mutate(raw)
        if not raws:  # a board that was told to stop still sends
            self.mutated += 1
            out += self._mutate(self._pool[int(self._rng.integers(len(self._pool)))][1])
        if self.kind == "serial":
            return b"".join(cobs.encode(raw) + b"\0" for raw in out)
        frames: list[CanFrame] = []
        for raw in out:
            frames += self._segment(raw)
        return tuple(frames)

    def _raws(self, payload: Any) -> Iterator[bytes]:
        """Packets in what a board sends."""
        if self.kind == "serial":
            for frame in payload.split(b"\0"):
                if frame:
                    raw = cobs.decode(frame)
                    if raw is not None:
                        yield raw
            return
        decoder = CanDecoder()
        for received in decoder.feed(list(payload)):
            if not isinstance(received.message, FloatSamples):
                yield pack(received.message, received.board)

    def _segment(self, raw: bytes) -> tuple[CanFrame, ...]:
        kind, board = raw[0], raw[1] & 0x7F
        transfer = self._transfers[kind]
        self._transfers[kind] = (transfer + 1) % 32
        known = MessageType.SAMPLES
        can_id = identifier(known, board) & ~(0xFF << 8) | kind << 8
        return segment(raw, can_id, transfer, True)

    def _mutate(self, raw: bytes) -> list[bytes]:
        """One or more packets, each with a right CRC."""
        rng = self._rng
        name = str(rng.choice(_WAYS))
        self.kinds[name] += 1
        head, body = bytearray(raw[:4]), bytearray(raw[4:-4])
        match name:
            case "field" if body:
                size = int(rng.choice((1, 2, 4, 8)))
                at = int(rng.integers(len(body)))
                extreme = int(rng.choice(EXTREMES))
                body[at : at + size] = bytes([extreme] * min(size, len(body) - at))
            case "bits" if body:
                for _ in range(int(rng.integers(1, 6))):
                    body[int(rng.integers(len(body)))] ^= 1 << int(rng.integers(8))
            case "noise" if body:
                body[:] = rng.bytes(len(body))
            case "shorter" if body:
                del body[int(rng.integers(len(body))) :]
            case "longer":
                body += rng.bytes(int(rng.integers(1, 64)))
            case "type":
                head[0] = int(rng.integers(256))
            case "board":
                head[1] = int(rng.integers(128))
            case "other":
                return [self._pool[int(rng.integers(len(self._pool)))][1]]
            case "time" if len(body) >= 12:
                at = int(rng.choice((2, 4, 6, 8)))
                struct.pack_into("<I", body, at, int(rng.integers(1 << 32)))
            case "again":
                return [raw] * int(rng.integers(2, 6))
        return [_pack(bytes(head), bytes(body))]

    def _corrupt_floats(self, payload: bytes) -> bytes:
        rng = self._rng
        if not payload:
            return payload
        self.mutated += 1
        name = str(rng.choice(_FLOAT_WAYS))
        self.kinds[name] += 1
        data = bytearray(payload)
        values = len(data) // 4
        match name:
            case "field":
                for _ in range(int(rng.integers(1, 5))):
                    at = 4 * int(rng.integers(max(values, 1)))
                    value = float(np.float32(rng.choice(FLOATS)))
                    if at + 4 <= len(data):
                        struct.pack_into("<f", data, at, value)
            case "noise":
                scale = 10.0 ** float(rng.uniform(-3, 8))
                count = int(rng.integers(1, 21))
                field = rng.normal(0, scale, (count, 3)).astype(np.float32)
                warm = rng.normal(25, scale, count).astype(np.float32)
                status = np.zeros(count, np.uint8)
                return encode_anyskin(FloatSamples(field, warm, status))
            case "bits":
                data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            case "shorter":
                del data[int(rng.integers(len(data))) :]
            case "again":
                return bytes(data) * int(rng.integers(2, 6))
        return bytes(data)


_WAYS = (
    "field",
    "bits",
    "noise",
    "shorter",
    "longer",
    "type",
    "board",
    "other",
    "time",
    "again",
)
_FLOAT_WAYS = ("field", "noise", "bits", "shorter", "again")


def _pack(head: bytes, body: bytes) -> bytes:
    packed = head[:2] + struct.pack("<H", len(body)) + body
    return packed + struct.pack("<I", crc32c(packed))
