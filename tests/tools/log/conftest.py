"""Small logs, and the tools run within this process."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from tactile_core.bus import topics
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.log.info import info
from tactile_core.log.mcap_file import ChunkBuffer, DiskStorage, McapFile
from tactile_core.log.recorder import Recorder, RecorderSettings
from tactile_tools.cli import main

BASE_NS = 1_700_000_000_000_000_000
VECTOR = "geometry_msgs/msg/Vector3"


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


@pytest.fixture
def log_tool(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """``log_tool("info", path)``: run `tactile log` within this process."""

    def run(*words: str | Path) -> Outcome:
        capsys.readouterr()
        try:
            code = main(["log", *map(str, words)])
        except SystemExit as error:  # argparse's own refusals
            code = int(error.code or 0)
        outcome = Outcome(code, *capsys.readouterr())
        assert "Traceback" not in outcome.err
        return outcome

    return run


@pytest.fixture
def tiny_log() -> Callable[..., bytes]:
    """``tiny_log(path)``: write a complete log of some 1.4 kB with all kinds of records."""

    def write(
        path: Path,
        library: str = "t",
        profile: str = "ros2",
        count: int = 6,
        text: bytes = b"float64 x\nfloat64 y\nfloat64 z\n",
    ) -> bytes:
        file = McapFile(path, DiskStorage(), library, profile)
        file.add_schema(1, VECTOR, "ros2msg", text)
        file.add_channel(1, 1, "/v", "cdr", {})
        file.add_metadata("m", {"a": "b"})
        file.add_attachment("f", "text/plain", b"x", BASE_NS, BASE_NS)
        for part in range(2):
            chunk = ChunkBuffer()
            for i in range(count // 2):
                number = part * count // 2 + i
                at = BASE_NS + number * 10_000_000
                data = codec().encode(VECTOR, MSG.Vector3(float(number), 0.5, -1.0))
                chunk.add(1, number, at, at, data)
            file.add_chunk(chunk.seal(zstandard.ZstdCompressor()))
            file.commit()
        file.finish()
        return path.read_bytes()

    return write


@pytest.fixture(scope="session")
def recorded() -> Callable[..., Path]:
    """``recorded(path, seconds=1.0)``: features, commands and events as our daemons log them."""

    def write(path: Path, seconds: float = 1.0, start: float = 0.0, **settings: Any) -> Path:
        quick = {"flush_period": 0.05, "min_free_bytes": 0} | settings
        recorder = Recorder(path, RecorderSettings(**quick))
        recorder.attach("finger.note", "text/plain", b"a file")
        recorder.metadata("board:finger", {"serial_number": "0011"})
        for i in range(round(seconds * 100)):
            at = BASE_NS + round((start + i / 100) * 1e9)
            number = i + round(start * 100)
            recorder.write(topics.FEATURES, "finger", features(at, number), at + 1_000_000, at)
            twist = MSG.Twist(MSG.Vector3(number * 1e-3, 0.0, 0.0), MSG.Vector3(0.0, 0.0, 0.1))
            command = MSG.ArmCommand(
                header(at, "cupboard"),
                twist,
                at,
                number + 1,
                0.06,
                "reach-1",
                np.zeros(16, np.uint8),
            )
            data = codec().encode(topics.COMMAND, command)
            recorder.write(topics.COMMAND, "arm", data, at + 2_000_000, at)
            if i % 50 == 0:
                event = MSG.ReachEvent(header(at, ""), i, "state", f"s{i}", "grüße, “quoted”")
                data = codec().encode(topics.REACH_EVENT, event)
                recorder.write(topics.REACH_EVENT, "reach", data, at + 3_000_000, at)
        assert recorder.close(20)
        return path

    return write


def features(at: int, number: int) -> bytes:
    zero, point = MSG.Vector3(0.0, 0.0, 0.0), MSG.Point(0.125, 0.25, 0.0)
    patch = MSG.ContactPatch(0, 1, 2, 1.5, 1.25, MSG.Vector3(0.0, -1.5, 0.0), point, zero, 0.1)
    message = MSG.ContactFeatures(
        header(at, "ee"), at, at + 500_000, 0.001, number, number % 10 != 0,
        ["taring"] if number % 10 == 0 else [], True, float(np.float32(number / 7)), 1, point, 1.5,
        MSG.Wrench(zero, zero), 0.0, 0.0, 2, 0, [patch] * (number % 3),
        ["taring"] if number % 10 == 0 else [], 0.1, 0.1, 0.1,
    )  # fmt: skip
    return codec().encode(topics.FEATURES, message)


@pytest.fixture(scope="session")
def counts() -> Callable[[Path], dict[str, int]]:
    """``counts(path)``: messages of each topic of a log."""

    def of(path: Path) -> dict[str, int]:
        return {channel.topic: channel.messages for channel in info(path).channels}

    return of


@pytest.fixture(scope="session")
def rows_of() -> Callable[[str], list[Any]]:
    """``rows_of(text)``: the JSON value of each line."""

    def read(text: str) -> list[Any]:
        return [json.loads(line) for line in text.splitlines()]

    return read
