"""A simulated board at a terminal of its own, served by a thread, that a test presses itself."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim_device.board.catalogue import build_skin
from sim_device.ports_plan import BoardsRequest, plan_boards
from sim_device.runner import Runner
from sim_device.skin.elastomer import Contact
from tests.support.tactiled_lab import CALM_HZ

RAMP_S = 0.1
"""A press comes and goes in so long, as a hand's does."""

RADIUS_M = 0.004


class OwnBoard:
    """An AnySkin board at ``link``. What is on its skin changes when a test says so."""

    def __init__(self, link: Path) -> None:
        skin = build_skin("anyskin", 0).geometry.arrays[0]
        self._place = skin.position.mean(axis=0)
        self._inward = -skin.rotation[0, :, 2]
        self._wanted_n, self._former_n, self._since = 0.0, 0.0, 0.0
        # Slowly: this thread shares a test's process, and a starved machine must keep up with it.
        request = BoardsRequest(
            ptys=(link,), board="anyskin", touched=self._touched, rate=float(CALM_HZ)
        )
        self._runner = Runner([plan.server for plan in plan_boards(request)])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._runner.run, args=(self._stop.is_set,))
        self._runner.open()
        self._thread.start()

    def press(self, normal_n: float) -> None:
        """Press with so much, N, in the middle of the skin; 0 takes everything off."""
        self._former_n, self._since = self._now_n(), time.monotonic()
        self._wanted_n = normal_n

    def close(self) -> None:
        """Unplug it."""
        self._stop.set()
        self._thread.join()
        self._runner.close()

    def _now_n(self) -> float:
        part = min(1.0, (time.monotonic() - self._since) / RAMP_S)
        return self._former_n + part * (self._wanted_n - self._former_n)

    def _touched(self) -> Sequence[Contact]:
        force = self._now_n()
        return [Contact(self._place, np.asarray(self._inward * force), RADIUS_M)] if force else []
