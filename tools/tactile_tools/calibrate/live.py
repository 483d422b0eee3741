"""The board of a running tactiled as the source of a recording."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from tactile_core.bus.messages import MSG, DecodeError, codec, header, stamp_ns
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.streams import BusSample, Tap, list_alive
from tactile_core.bus.topics import FIELD, REFERENCE, service_key
from tactile_core.calibration import BoardCalibration, load, nominal, saves
from tactile_core.calibration.file import SUFFIX
from tactile_core.calibration.nominal import NOMINAL_MODELS
from tactile_core.log.recorder import Recorder
from tactile_core.types import WallClock, monotonic_now
from tactile_tools.calibrate.wizard import Stamps, TareRefusedError, WizardError

FIRST_FRAME_S = 10.0
"""Time for tactiled to be found on the bus, to identify the board and to send a first frame, s; if
tactiled is there, `SLOW_S` more for a slow board."""
TARE_S = 120.0
"""Time for a tare of the slowest boards, s."""
SLOW_S = 30.0
"""Time that a recording may take longer than asked for, until a slow board has sent enough, s."""
LOOK_S = 0.05
REFUSED = "tare refused"
"""Beginning of what tactiled says of a tare that it did not take."""
STATUS_S = 10.0


class LiveBoard:
    """Board ``name`` on the bus; every frame goes to ``recorder`` from the moment this is made."""

    def __init__(self, session: zenoh.Session, recorder: Recorder, name: str) -> None:
        self._session, self._recorder, self._name = session, recorder, name
        self._lock = threading.Lock()
        self._stamps: list[int] = []
        self._frame = ""
        self._taxels = 0
        self._heard = threading.Event()
        self._wall = WallClock.take()
        self._tap = Tap(session, FIELD.key(name), self._take_field)

    def wait(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Wait for frames; `WizardError` when none come, or when their sender has ``ended``."""
        if self._hears(FIRST_FRAME_S, ended):
            return
        there = not ended() and self._name in list_alive(self._session)
        if not (there and self._hears(SLOW_S, ended)):
            raise WizardError(
                f"no frames of board {self._name!r} on the bus in {FIRST_FRAME_S:g} s; start "
                f"tactiled with --name {self._name}, or give --port"
            )

    def _hears(self, seconds: float, ended: Callable[[], bool]) -> bool:
        until = time.monotonic() + seconds
        while not (heard := self._heard.wait(0.1)):
            if ended() or time.monotonic() > until:
                break
        return heard

    def calibration(self, given: Path | None) -> BoardCalibration:
        """Load the calibration that tactiled uses for this board.

        It is read from ``given``, else from the file that tactiled names; typical figures where it
        uses no file. `WizardError` when ``given`` is another one; `CalibrationError` when the file
        is bad.
        """
        try:
            status = call(self._session, service_key(self._name, "status"), timeout=STATUS_S)
        except ServiceError as error:
            raise WizardError(str(error)) from error
        used: dict[str, Any] = status.get("calibration", {})
        if given is None and used.get("file"):
            given = Path(str(used["file"]))
        if given is None:
            return self._typical(str(status.get("model", "")), str(used.get("serial_number", "")))
        calibration = load(given)
        if calibration.hash != used.get("hash"):
            raise WizardError(
                f"{given} (board {calibration.serial_number}) is not what tactiled runs this board "
                f"with ({used.get('file') or 'typical figures'}); start both with the same file"
            )
        return calibration

    def attach(self, calibration: BoardCalibration) -> None:
        """Embed the calibration in the log, where `fit` finds it."""
        text = saves(calibration).encode()
        self._recorder.attach(f"{self._name}{SUFFIX}", "application/toml", text)

    def tare(self, force: bool = False) -> str:
        """Tare through tactiled's service."""
        key = service_key(self._name, "tare")
        try:
            report = call(self._session, key, {"force": force}, timeout=TARE_S)
        except ServiceError as error:
            kind = TareRefusedError if str(error).startswith(REFUSED) else WizardError
            raise kind(str(error)) from error
        return f"  {report['message']}"

    def collect(self, seconds: float, least: int) -> Stamps:
        """Wait for the frames of the next ``seconds`` s, or longer until there are ``least``."""
        start = time.monotonic()
        begin = self._wall.wall_ns(monotonic_now())
        time.sleep(seconds)
        while True:
            end = self._wall.wall_ns(monotonic_now())
            with self._lock:
                found = [stamp for stamp in self._stamps if begin <= stamp <= end]
            if len(found) >= least or time.monotonic() - start > seconds + SLOW_S:
                break
            time.sleep(LOOK_S)
        with self._lock:
            self._stamps = [stamp for stamp in self._stamps if stamp > end]
        return found

    def label(self, stamps: Stamps, force: float) -> None:
        """Write the force on the skin when these frames were captured; a `Sink`."""
        encode = codec().encode
        for stamp in stamps:
            message = MSG.WrenchStamped(
                header=header(stamp, self._frame),
                wrench=MSG.Wrench(MSG.Vector3(0.0, 0.0, -force), MSG.Vector3(0.0, 0.0, 0.0)),
            )
            data = encode(REFERENCE, message)
            self._recorder.write(REFERENCE, self._name, data, stamp, stamp)

    def close(self) -> None:
        """Stop listening."""
        self._tap.close()

    def _typical(self, model: str, serial_number: str) -> BoardCalibration:
        if model not in NOMINAL_MODELS:
            raise WizardError(
                f"no typical figures for model {model!r}; start tactiled with a --calibration that "
                "says where its taxels are"
            )
        found = nominal(
            model, serial_number or "unknown", None if model == "finger" else self._taxels
        )
        if found.geometry.taxels != self._taxels:
            raise WizardError(
                f"a typical {model} has {found.geometry.taxels} taxels, this one {self._taxels}; "
                "start tactiled with a --calibration that says where they are"
            )
        return found

    def _take_field(self, sample: BusSample) -> None:
        try:
            message = codec().decode(FIELD, sample.data)
        except DecodeError:
            return  # another version of tactiled; too few frames are reported elsewhere
        stamp = stamp_ns(message.header.stamp)
        self._frame = str(message.header.frame_id)
        self._taxels = int(message.array_taxels.sum())
        self._recorder.write(FIELD, self._name, sample.data, stamp, stamp)
        with self._lock:
            self._stamps.append(stamp)
        self._heard.set()


def refuse_existing(out: Path) -> str | None:
    """Say why ``out`` cannot be a new log; None when it can."""
    if out.suffix != ".mcap":
        return f"--out {out}; allowed: a name that ends in .mcap"
    if out.exists():
        return f"--out {out} is there already; name a new file"
    if not out.resolve().parent.is_dir():
        return f"--out {out}: no such folder: {out.parent}; create it"
    return None
