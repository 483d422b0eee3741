"""Diagnose a serial port without a board, from byte counts over its first seconds."""

from __future__ import annotations

import numpy as np

from sensor_proto.layouts import COUNT_UT, COUNTS
from sensor_proto.survey import Finding
from tactile_core.types import Instant, seconds_between
from tactiled.boards.events import Diagnosed, Waiting

GARBAGE_AFTER = 3.0
"""s of bytes without a frame before they count as garbage."""

ENOUGH = 12
"""Bursts of bytes before they count as garbage: a board is recognised by its third frame, and some
frames may be cut."""

PAUSE = 0.05
"""s without a byte that separate the frames of a slow board."""

PATIENCE = 30.0
"""s after which bytes count as garbage however rare they are: twelve frames at 0.5 Hz."""

LITTLE, LITTLE_UNTIL = 400, 15.0
"""Bytes that are too few for a diagnosis, and s until which more are awaited: five frames of a slow
board."""

NOTHING_AFTER = 5.0
"""s without a byte before the port counts as silent: boards that reset on opening boot in two."""

MOST_OF_A_FRAME = 2000
"""Bytes without a pause that exceed any frame: 322 bytes for twenty magnetometers, and room for
several in a row."""

SHOWN = 60
"""Characters of a foreign device's text that a message quotes."""

MOSTLY = 0.9
"""Share of zeros, or of printable characters, that decides what the bytes are."""

_PRINTABLE = np.zeros(256, bool)
_PRINTABLE[32:127] = True
_PRINTABLE[[9, 10, 13]] = True


class Diagnosis:
    """Watches a serial port until a board has been found on it; pure."""

    def __init__(self, port: str, baud: int, kind: str) -> None:
        self._port = port
        self._baud = baud
        self._kind = kind
        self._uart = True
        self.begin(Instant(0))

    def begin(self, now: Instant, uart: bool | None = None) -> None:
        """Start over. ``uart``: whether the port has a baud rate, which USB does not; None: the
        same port as before.
        """
        self._uart = self._uart if uart is None else uart
        self._since = now
        self._total = self._zeros = self._printable = 0
        self._text = b""
        self._bursts = 0
        self._first_byte = self._last_byte = now
        self._told = False

    def feed(self, data: bytes, now: Instant) -> None:
        """Count bytes that came at ``now``."""
        if not self._total:
            self._first_byte = now
        if not self._total or seconds_between(self._last_byte, now) >= PAUSE:
            self._bursts += 1
        self._last_byte = now
        values = np.frombuffer(data, np.uint8)
        self._total += len(data)
        self._zeros += len(data) - int(np.count_nonzero(values))
        self._printable += int(_PRINTABLE[values].sum())
        if len(self._text) < 2 * SHOWN:
            self._text = (self._text + data)[: 2 * SHOWN]

    @property
    def _patience(self) -> float:
        """s from the start to the diagnosis."""
        if not self._total:
            return NOTHING_AFTER
        if self._bursts >= ENOUGH or self._is_text or self._is_zeros:
            return GARBAGE_AFTER
        # Few bursts: either long ones, which are garbage, or the frames of a slow board.
        pouring = self._total / self._bursts > MOST_OF_A_FRAME
        return GARBAGE_AFTER if pouring else PATIENCE

    @property
    def _is_zeros(self) -> bool:
        return self._zeros >= MOSTLY * self._total

    @property
    def _is_text(self) -> bool:
        return self._printable >= MOSTLY * self._total

    def waiting(self, now: Instant) -> Waiting | None:
        """Reports, once, that bytes are too rare for a diagnosis yet."""
        waited = seconds_between(self._since, now)
        if self._told or self._bursts < 2 or not GARBAGE_AFTER <= waited < self._patience:
            return None
        self._told = True
        period = seconds_between(self._first_byte, self._last_byte) / (self._bursts - 1)
        return Waiting(
            f"{self._port} sends {self._total // self._bursts} bytes every {period:.1f} s; waiting "
            f"up to {PATIENCE:.0f} s for enough of them to tell which board this is"
        )

    def judge(
        self, now: Instant, answered: bool, finding: Finding | None = None
    ) -> Diagnosed | None:
        """Diagnose what is wrong; None while it is too early.

        ``answered``: whether frames of our protocol were decoded. ``finding``: result of the survey
        of the bytes.
        """
        waited = seconds_between(self._since, now)
        if waited < self._patience:
            return None
        if 0 < self._total < LITTLE and waited < LITTLE_UNTIL:
            return None
        port, asked = self._port, f"{waited:.0f} s"
        if not self._total:
            return Diagnosed(
                f"{port} is silent: not one byte in {asked}, and no answer to Identify",
                "check that this is the board's port (tactiled --list-ports), its power and its "
                "firmware"
                + ("; check --baud and that TX and RX are crossed" if self._uart else ""),
            )
        if answered:
            return Diagnosed(
                f"a board on {port} sends frames, but did not answer Identify in {asked}",
                "check the line from host to board (TX), then power-cycle the board",
            )
        if self._is_zeros:
            return Diagnosed(
                f"{port} floods zeros ({self._total} bytes in {asked}, no frame among them)",
                "the line is held low or the baud rate is far too high: check wiring, power and "
                f"--baud (now {self._baud})"
                if self._uart
                else "the board sends no readings: check its chips, wiring and firmware",
            )
        if finding is not None:
            return Diagnosed(f"{port} sends {finding.what}", self._declare(finding))
        if self._is_text:
            return Diagnosed(
                f"{port} sends text, not taxel frames: {_first_line(self._text)!r}",
                "this seems to be another device or another firmware; give the board's port "
                "(tactiled --list-ports)",
            )
        other = "auto or tactile" if self._kind not in ("auto", "tactile") else "auto"
        kind = f", or give --kind {other}" if self._kind != "auto" else ""
        baud = f"the baud rate may be wrong (--baud, now {self._baud}), or " if self._uart else ""
        return Diagnosed(
            f"{port} sends {self._total} bytes in {asked} and no valid frame among them",
            f"{baud}the device speaks neither our protocol nor AnySkin's: declare it "
            f"with --kind (see tactiled --help){kind}",
        )

    def _declare(self, finding: Finding) -> str:
        """How to declare the layout of ``finding``."""
        if not finding.declare:
            return "see sensor_proto/PROTOCOL.md, section 9, for what can be declared with --kind"
        remedy = f"declare it with --kind {' or --kind '.join(finding.declare)}"
        if finding.declare[0].partition(":")[0] in COUNTS:
            xy, _, z = COUNT_UT
            remedy += f" (scale={xy:g}/{z:g} µT a count is meant: the MLX90393 at gain 7)"
        return remedy


def _first_line(text: bytes) -> str:
    lines = [line for line in text.decode("ascii", "replace").splitlines() if line.strip()]
    return lines[0].strip()[:SHOWN] if lines else ""
