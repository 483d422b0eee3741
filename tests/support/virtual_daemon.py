"""tactiled's own port, line and session with a simulated board, on virtual time, into a log."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from sensor_proto.packets import SetRate
from sim_device.board.catalogue import build_skin, factory_calibration, identity
from sim_device.board.firmware import CanBoard, SerialBoard
from sim_device.skin.skin import Contact
from tactile_core.bus.messages import codec
from tactile_core.bus.topics import RAW, Topic
from tactile_core.calibration import BoardCalibration
from tactile_core.log.recorder import Recorder, RecorderSettings
from tactile_core.types import NS_PER_S, Instant, WallClock
from tactiled import journal as kinds
from tactiled.blocks import Chunk
from tactiled.board_session import BoardSession
from tactiled.boards.board import BoardLink
from tactiled.boards.events import Identity, Refusal
from tactiled.boards.line import bus_names, make_line
from tactiled.calibration_store import CalibrationStore
from tactiled.journal import Journal
from tactiled.port import Port
from tactiled.publisher import split
from tactiled.reader import Inbox, PortLost, PortOpened, Wake
from tactiled.rerun import PIPELINE, PORT_PREFIX, RecordedSource
from tactiled.sensing.settings import PipelineSettings
from tactiled.transports.base import Medium
from tactiled.transports.recorded_log import to_raw

SEED = 7
STEP_NS = NS_PER_S // 500
POWER_ON = Instant(500 * NS_PER_S)
WALL = WallClock(1_700_000_000 * NS_PER_S)


def press(seconds: float) -> list[Contact]:
    """3 N on the left side from 1.5 s on."""
    if seconds < 1.5:
        return []
    left = build_skin("finger", SEED).geometry.arrays[0]
    return [Contact(left.position[11], left.rotation[11] @ np.array([0.0, 0.0, -3.0]), 0.008)]


class LogSink:
    """tactiled's publisher without a bus."""

    def __init__(self, recorder: Recorder) -> None:
        self.wall = WALL
        self.recorder: Recorder | None = recorder
        self.moment = POWER_ON

    def now(self) -> Instant:
        return Instant(self.moment + 123_457)

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        assert self.recorder is not None
        data = codec().encode(topic, message)
        self.recorder.write(topic, name, data, self.wall.wall_ns(self.now()), stamp_ns)

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        pass

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        pass


class Source(RecordedSource):
    """A port that keeps what is written to it, for the board."""

    def __init__(self, medium: Medium) -> None:
        super().__init__("virtual", medium)
        self.written: list[Any] = []

    def write(self, data: Any) -> None:
        self.written.append(data)


class VirtualDaemon:
    """One port and its boards; `run` it for some seconds, then `close` it."""

    def __init__(
        self,
        path: Path,
        boards: list[SerialBoard] | list[CanBoard],
        calibrations: list[BoardCalibration],
        settings: PipelineSettings | None = None,
        *,
        rate: float | None = None,
        recorder: RecorderSettings | None = None,
        inbox: int = 1024,
    ) -> None:
        settings = settings or PipelineSettings()
        can = isinstance(boards[0], CanBoard)
        medium = Medium.CAN if can else Medium.SERIAL
        self.boards = boards
        self.recorder = Recorder(path, recorder or RecorderSettings(min_free_bytes=0), clock=WALL)
        self.recorder.metadata(PIPELINE, _pipeline(settings))
        self.recorder.metadata(PORT_PREFIX + "finger", _port(can, rate))
        self.sink = LogSink(self.recorder)
        store = CalibrationStore((), strict=False)
        for calibration in calibrations:
            store.add(Path(calibration.serial_number), calibration)
        self.store = store
        self.source = Source(medium)
        self.inbox = Inbox(Wake(), limit=inbox)
        self.line = make_line(
            "virtual", self._admit, medium, kind="auto", rate=rate, baud=115_200, fd=can,
            nodes=None, listen_only=False,
        )  # fmt: skip
        self.port = Port(
            "finger", self.line, self.source, self.inbox, self._names,
            lambda _, node, name: BoardSession(name, self.sink, store, settings),
            True, Journal(self.sink, "finger", "virtual"),
        )  # fmt: skip
        if not can:
            self.port.add_board(0, "finger")
        self.now = POWER_ON
        self.plugged = True
        self.stalled = False
        self.open()

    def _admit(self, node: int, who: Identity) -> Refusal | None:
        return self.port.admit(node, who)

    def _names(self, nodes: tuple[int, ...], late: bool) -> dict[int, str]:
        return bus_names("finger", {}, nodes, late)

    def open(self) -> None:
        self.inbox.put(PortOpened("", 0.0))
        self.plugged = True

    def unplug(self) -> None:
        self.inbox.put(PortLost("it went"))
        self.plugged = False

    def tare(self) -> Future[dict[str, Any]]:
        session = self.port.boards[0]
        done = session.tare()
        self.port.note(kinds.TARE, self.now)
        return done

    def set_rate(self, rate: float) -> None:
        link = self.line.links[0]
        assert isinstance(link, BoardLink)
        link.request(lambda number: SetRate(number, round(rate * 1000)), self.now)
        self.port.note(kinds.SET_RATE, self.now, value=rate)

    def recalibrate(self, calibration: BoardCalibration) -> None:
        self.store.add(Path("new"), calibration)
        self.port.retry(0, self.now)
        told = self.port.boards[0].recalibrate()
        self.port.note(kinds.RECALIBRATE, self.now, text=told["hash"])

    def run(self, seconds: float) -> None:
        """Run boards and host in steps of 2 ms; a stalled pipeline does not read its inbox."""
        for _ in range(round(seconds * 500)):
            self.now = Instant(self.now + STEP_NS)
            self.sink.moment = self.now
            for payload in self.source.written:
                for board in self.boards:
                    if self.plugged:
                        board.receive(payload, self.now)
            self.source.written.clear()
            for index, board in enumerate(self.boards):
                payload = board.tick(self.now)
                if payload and self.plugged:
                    chunk = Chunk(Instant(self.now + index), payload)
                    self.inbox.put(chunk)
                    self._log_raw(chunk)
            if not self.stalled:
                self.port.pump(Instant(self.now + 100_003))

    def close(self) -> None:
        self.port.stop_streaming(self.now)
        assert self.recorder.close(60)

    def _log_raw(self, chunk: Chunk) -> None:
        stamp = WALL.wall_ns(chunk.received)
        for part in split(chunk):
            self.recorder.write(
                RAW, "finger", codec().encode(RAW, to_raw(part, "virtual", WALL)), stamp, stamp
            )


def make_board(**options: Any) -> SerialBoard:
    return SerialBoard(build_skin("finger", SEED), identity("finger", SEED), **options)


def make_can_board(seed: int, node: int, **options: Any) -> CanBoard:
    return CanBoard(
        build_skin("finger", seed), identity("finger", seed), node=node, fd=True, **options
    )


def calibration(seed: int = SEED) -> BoardCalibration:
    return factory_calibration("finger", seed)


def _pipeline(settings: PipelineSettings) -> dict[str, str]:
    import json
    from dataclasses import asdict

    return {key: json.dumps(value) for key, value in asdict(settings).items()}


def _port(can: bool, rate: float | None) -> dict[str, str]:
    import json

    return {
        "spec": "virtual", "medium": "can" if can else "serial", "kind": "auto", "baud": "115200",
        "fd": json.dumps(can), "rate": json.dumps(rate), "strict": "false", "nodes": "{}",
    }  # fmt: skip


Make = Callable[..., VirtualDaemon]
