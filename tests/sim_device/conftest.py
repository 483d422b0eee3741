"""Simulated skins, and a host that drives boards through the real codecs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from sensor_proto.can_transfers import CanDecoder, CanEncoder
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Message, Received, Samples
from sim_device.board.firmware import CanBoard, Identity, SerialBoard
from sim_device.skin.environment import Environment, EnvironmentParameters
from sim_device.skin.parameters import SkinParameters
from sim_device.skin.skin import SkinModel
from tactile_core.geometry import Side, SkinGeometry, grid_on_plane
from tactile_core.types import Instant

MS = 1_000_000


def flat(shape: tuple[int, int] = (4, 4), pitch: float = 0.016) -> SkinGeometry:
    """One flat array whose taxel axes are those of ee."""
    array = grid_on_plane("pad", Side.TIP, shape, (pitch, pitch), (0.0, 0.0, 0.0), np.eye(3))
    return SkinGeometry("pad", "ee", (array,))


@pytest.fixture
def flat_geometry() -> Callable[..., SkinGeometry]:
    return flat


@pytest.fixture
def calm() -> Environment:
    """No ambient field, and always 25 °C."""
    return Environment(
        EnvironmentParameters(field_ut=0, gradient_ut_per_m=0, room_c=25, self_heating_k=0)
    )


@pytest.fixture
def ideal_skin() -> Callable[..., SkinModel]:
    def make(shape: tuple[int, int] = (4, 4), pitch: float = 0.016) -> SkinModel:
        return SkinModel(flat(shape, pitch), SkinParameters().ideal(), np.random.default_rng(0))

    return make


@pytest.fixture
def real_skin() -> Callable[..., SkinModel]:
    def make(seed: int = 1, shape: tuple[int, int] = (4, 4)) -> SkinModel:
        return SkinModel(flat(shape), SkinParameters(), np.random.default_rng(seed))

    return make


@pytest.fixture
def identity() -> Identity:
    return Identity(bytes(range(1, 9)), "pad")


Log = list[tuple[int, Received]]


class Host:
    """Sends commands at given milliseconds and records every message with its arrival in ms."""

    def __init__(self, board: SerialBoard | CanBoard, fd: bool = False) -> None:
        self.board = board
        self.decoder: SerialDecoder | CanDecoder
        self.log: Log = []
        self.raw: list[object] = []
        self.now_ms = 0
        if isinstance(board, CanBoard):
            self._encoder = CanEncoder(board.node, fd)
            self.decoder = CanDecoder()
        else:
            self.decoder = SerialDecoder()

    def run(self, until_ms: int, commands: Mapping[int, Sequence[Message]] | None = None) -> None:
        for ms in range(self.now_ms, until_ms):
            now = Instant(ms * MS)
            for message in (commands or {}).get(ms, ()):
                self.send(message, now)
            self.collect(ms)
        self.now_ms = until_ms

    def send(self, message: Message, now: Instant) -> None:
        if isinstance(self.board, CanBoard):
            self.board.receive(self._encoder.encode(message), now)
        else:
            self.board.receive(encode_serial(message), now)

    def collect(self, ms: int) -> None:
        if isinstance(self.board, CanBoard):
            frames = self.board.tick(Instant(ms * MS))
            self.raw += frames
            assert isinstance(self.decoder, CanDecoder)
            received = self.decoder.feed(frames)
        else:
            data = self.board.tick(Instant(ms * MS))
            self.raw.append(data)
            assert isinstance(self.decoder, SerialDecoder)
            received = self.decoder.feed(data)
        self.log += [(ms, r) for r in received]

    def of(self, kind: type) -> list[Message]:
        return [r.message for _, r in self.log if isinstance(r.message, kind)]

    @property
    def sequences(self) -> list[int]:
        return [m.sequence for m in self.of(Samples) if isinstance(m, Samples) and m.array == 0]


@pytest.fixture
def host() -> type[Host]:
    return Host


@pytest.fixture
def serial(real_skin: Callable[..., SkinModel], identity: Identity) -> Callable[..., Host]:
    """Host on a serial line, with its board."""

    def make(**options: Any) -> Host:
        return Host(SerialBoard(real_skin(), identity, **options))

    return make
