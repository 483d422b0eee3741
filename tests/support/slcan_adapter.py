"""A simulated slcan adapter, served by a thread."""

from __future__ import annotations

import threading
import time

from sensor_proto.can_transfers import CanFrame
from sim_device.ports import SlcanPort
from tactile_core.types import monotonic_now


class AdapterThread:
    """A simulated slcan adapter that serves its port until stopped."""

    def __init__(self, port: SlcanPort) -> None:
        self.port = port
        self.received: list[CanFrame] = []
        self._to_send: list[tuple[CanFrame, ...]] = []
        self._bus_off: bool | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        port.open()
        self._thread.start()

    def send(self, *frames: CanFrame) -> None:
        self._to_send.append(frames)

    def set_bus_off(self, fault: bool) -> None:
        self._bus_off = fault

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.port.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.received += self.port.receive()
            fault, self._bus_off = self._bus_off, None
            if fault is not None:
                self.port.set_bus_off(fault)
            while self._to_send and self.port.adapter.is_open:
                self.port.send(self._to_send.pop(0), monotonic_now())
            self.port.flush(monotonic_now())
            time.sleep(0.001)
