"""Binary frames of a known layout to samples: the boundary is found, kept, and found again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sensor_proto.decoder import ACCEPTED, Reject, Tally
from sensor_proto.layout import COUNTS, Framing, Layout
from sensor_proto.packets import FloatSamples, Received, TaxelStatus
from sensor_proto.temperature import COLDEST_C, HOTTEST_C, plausible

LOCK_FRAMES = 3
"""Consecutive frames that must fit before a boundary is believed."""

SURE_BYTES = 2
"""Bytes of start, check and end that make one frame by itself believable, after a loss."""

SUSPECT_FRAMES = 3
"""Consecutive frames with mostly impossible numbers after which the boundary is doubted."""

MAX_FIELD_UT = 1e6
"""No count times the coarsest scale of a chip comes near this."""

LEAST_UT = 1e-6
"""A float closer to nought that is not nought is made of bytes that are none."""

PIECE = 4096
"""Bytes taken at a time: bounds the work of one search."""


class LayoutDecoder:
    """Frames of ``layout`` to `FloatSamples`, temperatures NaN where the frames have none.

    A layout without start, check and end is told by reads that each hold whole frames, as a board
    that pauses between its frames brings them about.
    """

    def __init__(self, layout: Layout) -> None:
        if layout.framing is None:
            raise ValueError(f"{layout} does not say what stands round the numbers")
        self.layout = layout
        self._framing: Framing = layout.framing
        self._size = layout.size
        self._bare = self._framing.extra == 0
        marks = len(self._framing.start) + bool(self._framing.check) + len(self._framing.end)
        self._alone = marks >= SURE_BYTES
        framing = self._framing
        self._weak = layout.kind in COUNTS and not self._alone
        self._open_ended = bool(framing.start) and not (framing.end or framing.check)
        self._tally = Tally((Reject.LOST_LOCK, Reject.DISCARDED_BYTES, Reject.CRC))
        self.reset()

    @property
    def counters(self) -> dict[str, int]:
        """Frames accepted, times the boundary was lost, bytes of no frame, wrong checks."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget boundary and unfinished input."""
        self._buffer = b""
        self._locked = self._known = False
        self._suspect = self._astray = 0

    def feed(self, data: bytes, /) -> list[Received]:
        """Frames that ``data`` completed; on a fresh lock also those held back until then."""
        out: list[Received] = []
        if self._bare or self._weak:
            self._look_at_read(data)
        step = max(len(data), 1) if self._bare else PIECE  # only whole reads tell anything
        for begin in range(0, len(data), step):
            piece = data[begin : begin + step]
            self._feed(piece, max(0, len(data) - begin - step), len(data), out)
        return out

    def _feed(self, piece: bytes, later: int, fed: int, out: list[Received]) -> None:
        buffer = self._buffer + piece
        at = 0
        while True:
            if self._locked:
                at += self._take(buffer, at, later, fed, out)
                if self._locked:
                    break
            start = self._search(buffer, at, whole_read=not later)
            if start is None:
                surplus = len(buffer) - at - (2 * LOCK_FRAMES + 2) * self._size
                if surplus > 0:
                    self._tally[Reject.DISCARDED_BYTES] += surplus
                    at += surplus
                break
            self._tally[Reject.DISCARDED_BYTES] += start - at
            at = start
            self._locked = self._known = True
            self._suspect = 0
        self._buffer = buffer[at:]

    def _look_at_read(self, data: bytes) -> None:
        """Let reads that hold whole frames tell where these begin, where marks do not.

        Without marks one is enough: what came before it has lost bytes. With one byte of marks,
        which the numbers may hold as well, some in a row are.
        """
        whole = bool(data) and len(data) % self._size == 0
        astray = whole and len(self._buffer) % self._size > 0
        self._astray = self._astray + 1 if astray else 0
        if self._astray >= (1 if self._bare else LOCK_FRAMES):
            self._astray = 0
            self._tally[Reject.LOST_LOCK] += self._locked
            self._tally[Reject.DISCARDED_BYTES] += len(self._buffer)
            self._buffer, self._locked = b"", False

    def _take(self, buffer: bytes, at: int, later: int, fed: int, out: list[Received]) -> int:
        """Append the frames from ``at`` on, and unlock where they cease to fit; bytes taken."""
        size = self._size
        whole = (len(buffer) - at) // size
        if not whole:
            return 0
        raw = np.frombuffer(buffer, np.uint8, whole * size, at).reshape(whole, size)
        fits = self._marked(raw)
        if self._open_ended:
            # Only what follows tells that no byte of the last frame is missing.
            fits &= np.append(self._begins(raw[1:]), self._may_begin(buffer, at + whole * size))
        fitting = whole if fits.all() else int(fits.argmin())
        if fitting < whole:
            self._lose(raw[fitting])
        field, temperature, values = self._samples(raw[:fitting])
        fitting = self._trusted(temperature, values)
        status = self._status(field, temperature)
        self._tally[ACCEPTED] += fitting
        for i in range(fitting):
            trailing = min(len(buffer) - at - (i + 1) * size + later, fed)
            for array in (field, temperature, status):
                array.flags.writeable = False
            out.append(Received(FloatSamples(field[i], temperature[i], status[i]), 0, trailing))
        return fitting * size

    def _lose(self, frame: NDArray[np.uint8]) -> None:
        self._locked = False
        self._tally[Reject.LOST_LOCK] += 1
        if self._framing.check and self._marked(frame[None], check=False).all():
            self._tally[Reject.CRC] += 1

    def _begins(self, raw: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which of (k, size) bytes have the start."""
        start = np.frombuffer(self._framing.start, np.uint8)
        begun: NDArray[np.bool_] = (raw[:, : len(start)] == start).all(axis=1)
        return begun

    def _may_begin(self, buffer: bytes, at: int) -> bool:
        """Whether a frame may begin at ``at``, where the buffer may end."""
        start = self._framing.start
        return start.startswith(buffer[at : at + len(start)])

    def _marked(self, raw: NDArray[np.uint8], check: bool = True) -> NDArray[np.bool_]:
        """Which of (k, size) bytes have start, end and check where they belong."""
        framing = self._framing
        fits = np.ones(len(raw), np.bool_)
        for i, byte in enumerate(framing.start):
            fits &= raw[:, i] == byte
        for i, byte in enumerate(reversed(framing.end)):
            fits &= raw[:, -1 - i] == byte
        if framing.check and check:
            place = framing.before + self.layout.payload
            covered = raw[:, len(framing.start) : place]
            if framing.check == "xor":
                right = np.bitwise_xor.reduce(covered, axis=1)
            else:
                right = covered.sum(axis=1, dtype=np.uint8)
            fits &= raw[:, place] == right
        return fits

    def _samples(
        self, raw: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.generic]]:
        before = self._framing.before
        body = raw[:, before : before + self.layout.payload]
        values = np.ascontiguousarray(body).view(self.layout.dtype)
        field, temperature = self.layout.samples(values)
        return field, temperature, values

    def _likely(
        self, temperature: NDArray[np.float32], values: NDArray[np.generic]
    ) -> NDArray[np.bool_]:
        """Which of k frames hold mostly numbers that a chip can give."""
        if "t" in self.layout.fields:
            with np.errstate(invalid="ignore"):
                likely: NDArray[np.bool_] = plausible(temperature).mean(axis=1) >= 0.5
            return likely
        if self.layout.kind in COUNTS:
            return np.ones(len(values), np.bool_)
        with np.errstate(invalid="ignore", over="ignore"):
            size = np.abs(values.astype(np.float64) * max(map(abs, self.layout.scale)))
            good = (size <= MAX_FIELD_UT) & ((size >= LEAST_UT) | (size == 0))
        mostly: NDArray[np.bool_] = good.mean(axis=1) >= 0.5
        return mostly

    def _trusted(self, temperature: NDArray[np.float32], values: NDArray[np.generic]) -> int:
        """Frames up to the one, if any, that puts the boundary in doubt."""
        likely = self._likely(temperature, values).tolist()
        for i, good in enumerate(likely):
            self._suspect = 0 if good else self._suspect + 1
            if self._suspect >= SUSPECT_FRAMES:
                self._locked = False
                self._tally[Reject.LOST_LOCK] += 1
                return i + 1
        return len(likely)

    def _status(
        self, field: NDArray[np.float32], temperature: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        """(k, n) of `TaxelStatus`."""
        with np.errstate(invalid="ignore"):
            good = (np.abs(field) <= MAX_FIELD_UT).all(axis=2)
            if "t" in self.layout.fields:
                good &= (temperature >= COLDEST_C) & (temperature <= HOTTEST_C)
        return np.where(good, TaxelStatus.OK, TaxelStatus.READ_FAILED).astype(np.uint8)

    def _search(self, buffer: bytes, at: int, whole_read: bool) -> int | None:
        """Where the first believable frame begins; None: wait for more.

        Among frames that overlap the best supported wins: by those that follow it, by the end of
        one before it, and by the end of the read where the buffer ends with it (``whole_read``).
        """
        size = self._size
        if self._bare:
            enough = len(buffer) - at >= LOCK_FRAMES * size and (len(buffer) - at) % size == 0
            return at if enough and self._run(buffer, at) >= LOCK_FRAMES else None
        last = len(buffer) - size
        if last < at:
            return None
        windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(buffer, np.uint8), size)[
            at:
        ]
        starts = np.flatnonzero(self._marked(windows)) + at
        best: tuple[float, int] | None = None
        for start in starts.tolist():
            if best is not None and start >= best[1] + size:
                break
            run = self._run(buffer, start)
            if not run:
                continue
            end = self._framing.end
            follows = start == 0 and self._known
            follows |= bool(end) and buffer.endswith(end, 0, start)
            wanted = LOCK_FRAMES if not self._known else 1 if self._alone or follows else 2
            if run < wanted:
                if start + (run + 1) * size > len(buffer):
                    return None if best is None else best[1]
                continue
            closes = whole_read and (len(buffer) - start) % size == 0
            if self._weak and not closes and run < 2 * LOCK_FRAMES:
                continue  # a byte of the numbers may be like the end
            score = run + 0.5 * follows + 0.75 * closes
            if best is None or score > best[0]:
                best = score, start
        return None if best is None else best[1]

    def _run(self, buffer: bytes, start: int) -> int:
        """Consecutive frames from ``start`` on that fit and are likely, so many as matter."""
        most = 2 * LOCK_FRAMES if self._weak else LOCK_FRAMES
        whole = min((len(buffer) - start) // self._size, most)
        if not whole:
            return 0
        raw = np.frombuffer(buffer, np.uint8, whole * self._size, start).reshape(whole, -1)
        _, temperature, values = self._samples(raw)
        good = self._marked(raw) & self._likely(temperature, values)
        return whole if good.all() else int(good.argmin())
