"""Layouts of boards without a protocol: syntax, decoders of text and binary frames, temperatures.

The decoders find the frame boundary, keep it, and search again after a loss.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from sensor_proto.packets import ACCEPTED, FloatSamples, Received, Reject, Tally, TaxelStatus

# Recognising the temperature column of a chip, which tells layouts apart.
#
# Frames of four numbers per chip hold a temperature, frames of three do not, and twelve numbers may
# be either. A temperature is within what a chip survives, nearly the same on all chips of a board,
# and quiet: its noise is a few hundredths of a kelvin, that of a field some microtesla.


COLDEST_C, HOTTEST_C = -45.0, 130.0
"""Plausible temperatures. The MLX90393 works from −40 to 85 °C; the rest allows for self-heating
and trim."""

FAILED_C = (-998.1, 451.8)
"""Result of its temperature formula for raw 0 and 0xFFFF: the chip did not answer."""

TINY_C = 1e-3
"""Smallest plausible size except exactly 0. Half of all float bit patterns are below 1, but a
temperature in steps of 1/45.2 °C is never this close to 0."""

STEPS_PER_K = 45.2
"""Resolution of the chip's temperature, steps per kelvin (MLX90393 datasheet)."""

ON_STEP = 0.02
"""Tolerance, in steps, by which a float may miss a step."""

ALIKE_K = 25.0
"""Largest difference in K between the chips of one board, one of them beside a hot regulator."""

QUIET_K = 0.5
"""Largest median change in K between two frames. A chip's noise is a tenth of that; it warms more
slowly still."""

QUIETER = 3.0
"""How many times more a field (µT) varies than a temperature (K)."""

Float = NDArray[np.floating]


def plausible(temperature_c: Float) -> NDArray[np.bool_]:
    """Whether each value can come from a chip, working or dead; same shape as the input."""
    size = np.abs(temperature_c)
    usual = (temperature_c >= COLDEST_C) & (temperature_c <= HOTTEST_C)
    usual &= (size >= TINY_C) | (size == 0)
    for dead in FAILED_C:
        usual |= np.abs(temperature_c - np.float32(dead)) < 0.1
    return usual


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence that one column per chip is its temperature.

    ``likely``: it can be. ``stepped``: every value is on a step of the chip's thermometer, which
    fields are not. ``quieter``: it varies much less than the other columns.
    """

    likely: bool
    stepped: bool = False
    quieter: bool = False

    @property
    def sure(self) -> bool:
        """Whether the column is hardly a field."""
        return self.likely and (self.stepped or self.quieter)


def evidence(values: Float, column: int) -> Evidence:
    """Assess one column of ``values``, shape (frames, chips, numbers per chip)."""
    with np.errstate(invalid="ignore", over="ignore"):
        seen = np.asarray(values[:, :, column], np.float64)
        good = plausible(seen)
        alive = good & (seen >= COLDEST_C) & (seen <= HOTTEST_C)
        if good.mean() < 0.8:
            return Evidence(False)
        if not alive.any():
            return Evidence(True, stepped=True)  # all chips are dead and report it
        warm = np.where(alive, seen, np.nan)
        used = warm[alive.any(axis=1)]
        if (np.nanmax(used, axis=1) - np.nanmin(used, axis=1)).max() > ALIKE_K:
            return Evidence(False)
        moves = np.abs(np.diff(warm, axis=0))
        move = float(np.nanmedian(moves)) if np.isfinite(moves).any() else 0.0
        if move > QUIET_K:
            return Evidence(False)
        steps = warm[alive] * STEPS_PER_K
        off = np.abs(steps - np.round(steps))
        stepped = bool((off < ON_STEP).mean() > 0.9 and np.count_nonzero(steps))
        others = np.abs(np.diff(np.delete(values, column, axis=2).astype(np.float64), axis=0))
        others = others[np.isfinite(others)]
        other = float(np.median(others)) if others.size else 0.0
    return Evidence(True, stepped, other > QUIETER * move and other > 0)


def temperature_first(values: Float) -> bool | None:
    """Whether t is first in (frames, chips, 4), or last (False); None if that cannot be told."""
    first, last = evidence(values, 0), evidence(values, 3)
    if first.likely != last.likely:
        return first.likely
    if not first.likely or first.stepped == last.stepped:
        return None
    return first.stepped


def with_or_without(values: Float) -> str | None:
    """Order of the numbers of each chip in (frames, numbers): ``txyz``, ``xyzt`` or ``xyz``.

    None if that cannot be told, as with twelve numbers that hardly vary.
    """
    count = values.shape[1]
    threes, fours = count % 3 == 0, count % 4 == 0
    if fours:
        grouped = values.reshape(len(values), -1, 4)
        first = temperature_first(grouped)
        if first is not None and (not threes or evidence(grouped, 0 if first else 3).sure):
            return "txyz" if first else "xyzt"
        if first is not None or evidence(grouped, 0).likely:
            return None
    return "xyz" if threes else None


# How a board without a protocol writes its samples: kind of number, chips, order, framing.
#
# The syntax is ``KIND:nFIELDS[,OPTION…]``, as in ``floats:5xyz`` or
# ``int16:5xyz,big,scale=0.15/0.242,start=aa55,check=sum``; PROTOCOL.md section 9 has the grammar.


MAX_CHIPS = 20
"""Largest assembly on sale: four boards of five chips on one controller."""

MAX_EXTRA = 16
"""Most bytes or numbers per frame that do not belong to a chip."""

MAX_LINES = 64
"""Most lines of text per frame."""

RAW_AT_25_C = 46244
"""Temperature of integer layouts: T = 25 + (raw − 46244) / 45.2 °C (MLX90393 datasheet)."""

COUNT_UT = (0.15, 0.15, 0.242)
"""Default µT per count (x, y, z) of integer layouts: MLX90393 at gain 7, resolution 0."""

UNSIGNED_ZERO = 32768
"""Count at zero field in ``uint16``."""

ENDS = {"crlf": b"\r\n", "lf": b"\n", "cr": b"\r", "none": b""}


class Kind(StrEnum):
    """Number format."""

    FLOATS = "floats"
    DOUBLES = "doubles"
    INT16 = "int16"
    UINT16 = "uint16"
    INT32 = "int32"
    TEXT = "text"


_DTYPES = {
    Kind.FLOATS: "f4",
    Kind.DOUBLES: "f8",
    Kind.INT16: "i2",
    Kind.UINT16: "u2",
    Kind.INT32: "i4",
}
COUNTS = (Kind.INT16, Kind.UINT16, Kind.INT32)
"""Kinds whose fields are raw counts of the chip."""

CHECKS = ("", "xor", "sum")
"""Supported one-byte checks; they cover everything between ``start`` and the check."""

FORM = (
    "KIND:nFIELDS[,OPTION...], as in floats:5xyz, text:5txyz or int16:5xyz,big,start=aa55,check=sum"
    f"; KIND is one of {', '.join(Kind)}; FIELDS the order of x, y, z and t (°C) in each of n "
    "chips, _ for a number that is not used; OPTIONs are big, scale=XY/Z (µT a count), start=HEX, "
    "skip=BYTES, check=xor|sum, tail=BYTES, end=crlf|lf|cr|none|HEX, for text lead=NUMBERS and "
    "lines=COUNT"
)

_FORM = re.compile(r"(?P<kind>[a-z0-9]+):(?P<chips>[0-9]{1,3})(?P<fields>[xyzt_]+)(?P<rest>(,.*)?)")


@dataclass(frozen=True, slots=True)
class Framing:
    """Bytes around the numbers of a binary frame.

    ``start`` and ``end``: constant bytes of every frame. ``skip``: number of ignored bytes after
    ``start``, such as a counter. ``check``: one of `CHECKS`, after the numbers. ``tail``: number of
    ignored bytes after the numbers and the check.
    """

    start: bytes = b""
    skip: int = 0
    check: str = ""
    tail: int = 0
    end: bytes = b""

    @property
    def extra(self) -> int:
        """Bytes of a frame that are not numbers."""
        return self.before + bool(self.check) + self.tail + len(self.end)

    @property
    def before(self) -> int:
        """Bytes before the numbers."""
        return len(self.start) + self.skip


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the samples of ``chips`` magnetometers.

    ``fields``: the letters x, y, z (once each), t (at most once) and _ (unused), in the order of
    each chip's numbers. ``scale``: µT per unit of x, y, z. ``framing``: None for text and for
    binary frames whose framing is yet to be found. ``lead``: numbers before those of the first
    chip; ``lines``: lines per frame; both for text only.
    """

    kind: Kind
    chips: int
    fields: str
    big: bool = False
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    framing: Framing | None = None
    lead: int = 0
    lines: int = 1

    @classmethod
    def parse(cls, text: str) -> Layout:
        """Parse the syntax that users write. The ValueError it raises names what is allowed."""
        match = _FORM.fullmatch(text)
        if match is None or match["kind"] not in tuple(Kind):
            raise ValueError(f"{text!r} is not a layout; allowed: {FORM}")
        kind, chips, fields = Kind(match["kind"]), int(match["chips"]), match["fields"]
        if not 1 <= chips <= MAX_CHIPS:
            raise ValueError(f"{text!r} names {chips} chips; allowed: 1 to {MAX_CHIPS}")
        if any(fields.count(axis) != 1 for axis in "xyz") or fields.count("t") > 1:
            raise ValueError(
                f"{text!r} has the fields {fields}; allowed: x, y and z once each, t at most once, "
                "and _ for numbers that are not used"
            )
        scale = COUNT_UT if kind in COUNTS else (1.0, 1.0, 1.0)
        layout = cls(kind, chips, fields, scale=scale)
        for option in match["rest"].split(",")[1:]:
            layout = layout._with(option, text)
        return layout

    def _with(self, option: str, text: str) -> Layout:
        key, _, value = option.partition("=")
        framing = self.framing or Framing()
        try:
            if self.kind is Kind.TEXT:
                if key == "lead":
                    return replace(self, lead=_whole(value, 0, MAX_EXTRA))
                if key == "lines":
                    return replace(self, lines=_whole(value, 1, MAX_LINES))
            elif option == "big":
                return replace(self, big=True)
            elif key == "start":
                return replace(self, framing=replace(framing, start=_bytes(value)))
            elif key == "end":
                end = ENDS[value] if value in ENDS else _bytes(value)
                return replace(self, framing=replace(framing, end=end))
            elif key in ("skip", "tail"):
                size = _whole(value, 0, MAX_EXTRA)
                given = (
                    replace(framing, skip=size) if key == "skip" else replace(framing, tail=size)
                )
                return replace(self, framing=given)
            elif key == "check" and value and value in CHECKS:
                return replace(self, framing=replace(framing, check=value))
            if key == "scale":
                return replace(self, scale=_scale(value))
        except ValueError as error:
            raise ValueError(f"{text!r}: {option}: {error}; allowed: {FORM}") from error
        raise ValueError(f"{text!r}: {option!r} is not an option of {self.kind}; allowed: {FORM}")

    def __str__(self) -> str:
        """Return the syntax that users write."""
        words = [f"{self.kind}:{self.chips}{self.fields}"]
        if self.big:
            words.append("big")
        if self.scale != (COUNT_UT if self.kind in COUNTS else (1.0, 1.0, 1.0)):
            x, y, z = (f"{value:g}" for value in self.scale)
            scale = [x] if x == y == z else [x, z] if x == y else [x, y, z]
            words.append(f"scale={'/'.join(scale)}")
        if self.lead:
            words.append(f"lead={self.lead}")
        if self.lines > 1:
            words.append(f"lines={self.lines}")
        f = self.framing
        if f is not None:
            words += [f"start={f.start.hex()}"] if f.start else []
            words += [f"skip={f.skip}"] if f.skip else []
            words += [f"check={f.check}"] if f.check else []
            words += [f"tail={f.tail}"] if f.tail else []
            named = {end: name for name, end in ENDS.items()}.get(f.end, f.end.hex())
            words.append(f"end={named}")
        return ",".join(words)

    @property
    def numbers(self) -> int:
        """Numbers per frame, of all chips."""
        return self.chips * len(self.fields)

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Data type of one number in a binary frame."""
        return np.dtype((">" if self.big else "<") + _DTYPES[self.kind])

    @property
    def payload(self) -> int:
        """Size in bytes of the numbers of a binary frame."""
        return self.numbers * self.dtype.itemsize

    @property
    def size(self) -> int:
        """Size in bytes of a binary frame with its known framing."""
        return self.payload + (self.framing or Framing()).extra

    def samples(
        self, values: NDArray[np.generic]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Convert raw numbers (k, numbers) to field (k, chips, 3) in µT and temperature (k, chips)
        in °C.

        The temperature is NaN if the layout has none.
        """
        grouped = values.reshape(len(values), self.chips, len(self.fields)).astype(np.float64)
        counted = self.kind in COUNTS
        axes = [self.fields.index(axis) for axis in "xyz"]
        field = grouped[:, :, axes]
        if self.kind is Kind.UINT16:
            field = field - UNSIGNED_ZERO
        with np.errstate(over="ignore", invalid="ignore"):
            field = (field * np.array(self.scale)).astype(np.float32)
            if "t" not in self.fields:
                return field, np.full(grouped.shape[:2], np.nan, np.float32)
            raw = grouped[:, :, self.fields.index("t")]
            if counted:
                raw = 25.0 + (np.mod(raw, 65536) - RAW_AT_25_C) / STEPS_PER_K
            return field, raw.astype(np.float32)

    def encode(self, samples: FloatSamples, number: int = 0) -> bytes:
        """Encode a frame of ``samples`` (for text, one line with tabs), for simulated boards.

        ``number``: frame counter; its low byte becomes the first of the skipped bytes.
        """
        if len(samples.temperature_c) != self.chips:
            raise ValueError(f"{len(samples.temperature_c)} chips, the layout has {self.chips}")
        counted = self.kind in COUNTS
        grouped = np.zeros((self.chips, len(self.fields)))
        for i, letter in enumerate(self.fields):
            if letter == "t":
                t = np.asarray(samples.temperature_c, np.float64)
                grouped[:, i] = np.round((t - 25) * STEPS_PER_K) + RAW_AT_25_C if counted else t
            elif letter == "_":
                grouped[:, i] = np.arange(self.chips)
            else:
                axis = "xyz".index(letter)
                value = np.asarray(samples.field_ut[:, axis], np.float64) / self.scale[axis]
                if counted:
                    value = np.round(value) + (UNSIGNED_ZERO if self.kind is Kind.UINT16 else 0)
                grouped[:, i] = value
        if self.kind is Kind.TEXT:
            values = [float(number)] * self.lead + grouped.ravel().tolist()
            return "\t".join(f"{value:.2f}" for value in values).encode() + b"\r\n"
        if counted:  # values that do not fit wrap, as in a chip's register
            bits = 8 * self.dtype.itemsize
            unsigned = self.dtype.str.replace("i", "u")
            body = (np.round(grouped).astype(np.int64) % (1 << bits)).astype(unsigned)
        else:
            body = grouped.astype(self.dtype)
        framing = self.framing or Framing(end=b"\r\n")
        skipped = bytes([number % 256]) + bytes(framing.skip - 1) if framing.skip else b""
        checked = skipped + body.tobytes()
        check = bytes([check_of(framing.check, checked)]) if framing.check else b""
        return framing.start + checked + check + bytes(framing.tail) + framing.end


def check_of(check: str, data: bytes) -> int:
    """Check byte of ``data``."""
    if check == "xor":
        return reduce(lambda value, byte: value ^ byte, data, 0)
    return sum(data) % 256


def _whole(text: str, low: int, high: int) -> int:
    if not text.isdecimal() or not low <= int(text) <= high:
        raise ValueError(f"{text!r} is not a whole number from {low} to {high}")
    return int(text)


def _bytes(text: str) -> bytes:
    try:
        value = bytes.fromhex(text)
    except ValueError:
        value = b""
    if not 1 <= len(value) <= MAX_EXTRA:
        raise ValueError(f"{text!r} is not 1 to {MAX_EXTRA} bytes in hexadecimal")
    return value


def _scale(text: str) -> tuple[float, float, float]:
    try:
        values = [float(word) for word in text.split("/")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= 3 or not all(1e-6 <= abs(v) <= 1e6 for v in values):
        raise ValueError(f"{text!r} is not one to three numbers of µT, separated by /")
    xy, z = values[0], values[-1]
    return (xy, values[1] if len(values) == 3 else xy, z)


# Text lines: the numbers in a line, and the decoder for a known layout.
#
# Sketches separate their numbers by tabs, commas or spaces, with labels such as ``X0:`` or without,
# sometimes with nothing at all between two numbers of two decimals each.


MAX_LINE = 4096
"""Longest line in bytes; a longer one is discarded."""

MAX_FIELD_UT = 1e6
"""Field limit in µT: far above any count times a chip's coarsest scale."""

FORGET_AFTER = 20
"""Consecutive lines that do not fit after which the decimals are learnt again, as the firmware may
have changed."""

_END = re.compile(rb"[\r\n]+")
_MISSING = rb"(?:nan|inf|ovf|null|none|err(?:or)?|fail(?:ed)?)(?![A-Za-z])"
_WORD = rb"[A-Za-z_\xc2\xb5\xb0][A-Za-z0-9_\xc2\xb5\xb0]*"
_NUMBER = rb"[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?"
_TOKEN = re.compile(rb"(?P<gone>[-+]?%s)|(?P<word>%s)|(?P<number>%s)" % (_MISSING, _WORD, _NUMBER),
                    re.IGNORECASE)  # fmt: skip
_GLUED = re.compile(rb"[0-9]\.[0-9]+\.[0-9]")


@dataclass(frozen=True, slots=True)
class Tokens:
    """Numbers of one record.

    ``between``: text before each number and after the last, including words. ``decimals``: decimal
    places of each number; −1 for a failed reading (nan, ERR).
    """

    numbers: tuple[float, ...]
    decimals: tuple[int, ...]
    between: tuple[bytes, ...]

    @property
    def gone(self) -> int:
        """Number of failed readings."""
        return self.decimals.count(-1)


def tokens(line: bytes) -> Tokens:
    """Split a line into tokens.

    Adjoining numbers are separated by their equal number of decimals.
    """
    pattern = _TOKEN
    if _GLUED.search(line):
        places = len(line.rstrip(b" \t,;]").rpartition(b".")[2])
        fixed = rb"[-+]?[0-9]+\.[0-9]{%d}" % places
        pattern = re.compile(
            rb"(?P<gone>[-+]?%s)|(?P<word>%s)|(?P<number>%s)" % (_MISSING, _WORD, fixed),
            re.IGNORECASE,
        )
    numbers: list[float] = []
    decimals: list[int] = []
    between: list[bytes] = []
    since = 0
    for match in pattern.finditer(line):
        if match.lastgroup == "word":
            continue
        between.append(line[since : match.start()])
        since = match.end()
        if match.lastgroup == "gone":
            numbers.append(np.nan)
            decimals.append(-1)
        else:
            text = match.group()
            numbers.append(float(text))
            decimals.append(len(text.partition(b".")[2]) if b"." in text else 0)
    between.append(line[since:])
    return Tokens(tuple(numbers), tuple(decimals), tuple(between))


def join(parts: list[Tokens]) -> Tokens:
    """Join the tokens of several lines into one record."""
    between: list[bytes] = [b""]
    for part in parts:
        between[-1] += b"\n" + part.between[0]
        between += part.between[1:]
    return Tokens(
        tuple(n for part in parts for n in part.numbers),
        tuple(d for part in parts for d in part.decimals),
        tuple(between),
    )


def axis_of(before: bytes) -> str:
    """Axis named by the text before a number: x, y, z, t (temperature), or empty."""
    words: list[bytes] = re.findall(_WORD, before)
    for word in reversed(words):
        name = word.rstrip(b"0123456789_").decode("latin-1")
        if name.lower() in ("t", "temp", "temperature", "tempc", "degc"):
            return "t"
        if name and name[-1] in "xyzXYZ":
            head = name[:-1]
            if not head or head[-1] in "_0123456789" or head.lower() in ("b", "m", "h", "mag"):
                return name[-1].lower()
            if name[-1].isupper() and not head.isupper():
                return name[-1].lower()
    return ""


class TextDecoder:
    """Decodes text lines of ``layout`` (numbers of all chips, in order) to `FloatSamples`.

    Text between the numbers is ignored. The number of decimals of each number is learnt from the
    first lines and required of later ones, so that lines with a missing piece are dropped.
    """

    def __init__(self, layout: Layout) -> None:
        if layout.kind is not Kind.TEXT:
            raise ValueError(f"{layout} is not text")
        self.layout = layout
        self._wanted = layout.lead + layout.numbers
        self._tally = Tally((Reject.LOST_LOCK, Reject.DISCARDED_BYTES))
        self.reset()

    @property
    def counters(self) -> dict[str, int]:
        """Lines (frames) accepted, times their form was lost, and bytes of rejected lines."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget the unfinished line and the learnt form."""
        self._buffer = b""
        self._whole = False  # whether the start of a line has been seen
        self._record: list[Tokens] = []
        self._record_bytes = 0
        self._form: tuple[tuple[int, ...], int] | None = None
        self._wrong = 0
        self._label = b""  # text before the first number of a multi-line frame

    def feed(self, data: bytes, /) -> list[Received]:
        """Return the frames that ``data`` completed."""
        buffer = self._buffer + data
        out: list[Received] = []
        at = 0
        for match in _END.finditer(buffer):
            line, end = buffer[at : match.start()], match.end()
            if line.strip():
                if self._whole:
                    self._take(line, min(len(buffer) - end, len(data)), out)
                else:
                    self._tally[Reject.DISCARDED_BYTES] += len(line)
            self._whole = True
            at = end
        self._buffer = buffer[at:]
        if len(self._buffer) > MAX_LINE:
            self._tally[Reject.DISCARDED_BYTES] += len(self._buffer)
            self._buffer, self._whole = b"", False
        return out

    def _take(self, line: bytes, trailing: int, out: list[Received]) -> None:
        part = tokens(line)
        if self.layout.lines > 1:
            if not part.numbers:
                return  # a separator between two frames
            if self._begins(part):
                self._drop_record()
            elif not self._record:
                self._tally[Reject.DISCARDED_BYTES] += len(line)
                return
            self._record.append(part)
            self._record_bytes += len(line)
            if sum(len(p.numbers) for p in self._record) < self._wanted:
                return
            part = join(self._record)
        self._record_bytes += len(line) if self.layout.lines == 1 else 0
        numbers = self._matching_numbers(part)
        if numbers is None:
            self._drop_record()
            return
        self._record, self._record_bytes = [], 0
        values = np.array([numbers[self.layout.lead :]])
        field, temperature = self.layout.samples(values)
        status = self._status(field, temperature)
        for array in (field, temperature, status):
            array.flags.writeable = False
        self._tally[ACCEPTED] += 1
        out.append(Received(FloatSamples(field[0], temperature[0], status[0]), 0, trailing))

    def _begins(self, part: Tokens) -> bool:
        """Whether a line starts a frame: it names the first axis of the first chip.

        If the lines name no axis, any line may start one.
        """
        label = part.between[0].strip()
        axis = axis_of(label)
        if not axis:
            return not self._record
        if axis != self.layout.fields.lstrip("_")[:1]:
            return False
        if not self._label or label < self._label:
            self._label = label
        return label == self._label

    def _drop_record(self) -> None:
        self._tally[Reject.DISCARDED_BYTES] += self._record_bytes
        self._record, self._record_bytes = [], 0

    def _matching_numbers(self, part: Tokens) -> tuple[float, ...] | None:
        """Numbers of a record, if their count and decimals match the layout; otherwise None."""
        numbers, decimals = part.numbers, part.decimals
        missing = self._wanted - len(numbers)
        if missing > 0 and part.gone and missing % part.gone == 0:
            each = 1 + missing // part.gone  # one word replaces all numbers of a chip
            numbers = tuple(n for n, d in zip(numbers, decimals, strict=True)
                            for _ in range(each if d < 0 else 1))  # fmt: skip
            decimals = tuple(d for d in decimals for _ in range(each if d < 0 else 1))
        if len(numbers) != self._wanted:
            self._note_wrong_form()
            return None
        form = self._form
        if form is None:
            if min(decimals) < 0:
                return numbers
            self._form = decimals, 1
            return numbers
        learnt, seen = form
        if all(d in (-1, own) for d, own in zip(decimals, learnt, strict=True)):
            self._form, self._wrong = (learnt, seen + 1), 0
            return numbers
        if seen < 2:  # the first line may have been the damaged one
            self._form = decimals, 1
            return None
        self._note_wrong_form()
        return None

    def _note_wrong_form(self) -> None:
        self._wrong += 1
        if self._wrong >= FORGET_AFTER and self._form is not None:
            self._tally[Reject.LOST_LOCK] += 1
            self._form, self._wrong = None, 0

    def _status(
        self, field: NDArray[np.float32], temperature: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        with np.errstate(invalid="ignore"):
            good = (np.abs(field) <= MAX_FIELD_UT).all(axis=2)
            if "t" in self.layout.fields:
                good &= (temperature >= COLDEST_C) & (temperature <= HOTTEST_C)
        return np.where(good, TaxelStatus.OK, TaxelStatus.READ_FAILED).astype(np.uint8)


LOCK_FRAMES = 3
"""Consecutive frames that must fit before a boundary is accepted."""

SURE_BYTES = 2
"""Bytes of start, check and end that make a single frame credible after a loss."""

SUSPECT_FRAMES = 3
"""Consecutive frames with mostly implausible numbers after which the boundary is searched again."""

LEAST_UT = 1e-6
"""Smallest plausible size of a field except exactly 0; smaller floats are misread bytes."""

PIECE = 4096
"""Bytes processed at a time; bounds the work of one search."""


class LayoutDecoder:
    """Decodes binary frames of ``layout`` to `FloatSamples`.

    Temperatures are NaN if the frames have none. A layout without start, check and end is
    synchronised by reads that hold whole frames, as from a board that pauses between frames.
    """

    def __init__(self, layout: Layout) -> None:
        if layout.framing is None:
            raise ValueError(f"{layout} does not declare the bytes around the numbers")
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
        """Frames accepted, times the boundary was lost, bytes outside frames, and wrong checks."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget the boundary and unfinished input."""
        self._buffer = b""
        self._locked = self._known = False
        self._suspect = self._astray = 0

    def feed(self, data: bytes, /) -> list[Received]:
        """Return the frames completed by ``data``, and after a lock those held back."""
        out: list[Received] = []
        if self._bare or self._weak:
            self._synchronise_on_read(data)
        step = max(len(data), 1) if self._bare else PIECE  # only whole reads show the boundary
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

    def _synchronise_on_read(self, data: bytes) -> None:
        """Synchronise on reads that hold whole frames, where the marks do not suffice.

        Without marks, one such read is enough: data before it was lost. With one byte of marks,
        which may also occur in the numbers, several in a row are needed.
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
        """Append the frames from ``at`` on and return the bytes consumed.

        Unlock where they stop fitting.
        """
        size = self._size
        whole = (len(buffer) - at) // size
        if not whole:
            return 0
        raw = np.frombuffer(buffer, np.uint8, whole * size, at).reshape(whole, size)
        fits = self._marked(raw)
        if self._open_ended:
            # Only the bytes after the last frame show that none of its bytes is missing.
            fits &= np.append(self._begins(raw[1:]), self._may_begin(buffer, at + whole * size))
        fitting = whole if fits.all() else int(fits.argmin())
        if fitting < whole:
            self._lose_lock(raw[fitting])
        field, temperature, values = self._samples(raw[:fitting])
        fitting = self._trusted_frames(temperature, values)
        status = self._status(field, temperature)
        self._tally[ACCEPTED] += fitting
        for i in range(fitting):
            trailing = min(len(buffer) - at - (i + 1) * size + later, fed)
            for array in (field, temperature, status):
                array.flags.writeable = False
            out.append(Received(FloatSamples(field[i], temperature[i], status[i]), 0, trailing))
        return fitting * size

    def _lose_lock(self, frame: NDArray[np.uint8]) -> None:
        self._locked = False
        self._tally[Reject.LOST_LOCK] += 1
        if self._framing.check and self._marked(frame[None], check=False).all():
            self._tally[Reject.CRC] += 1

    def _begins(self, raw: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which rows of (k, size) bytes begin with the start."""
        start = np.frombuffer(self._framing.start, np.uint8)
        begun: NDArray[np.bool_] = (raw[:, : len(start)] == start).all(axis=1)
        return begun

    def _may_begin(self, buffer: bytes, at: int) -> bool:
        """Whether a frame may begin at ``at``; the buffer may end there."""
        start = self._framing.start
        return start.startswith(buffer[at : at + len(start)])

    def _marked(self, raw: NDArray[np.uint8], check: bool = True) -> NDArray[np.bool_]:
        """Which rows of (k, size) bytes have start, end and check in place."""
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

    def _plausible_frames(
        self, temperature: NDArray[np.float32], values: NDArray[np.generic]
    ) -> NDArray[np.bool_]:
        """Which of k frames hold mostly numbers that a chip can produce."""
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

    def _trusted_frames(self, temperature: NDArray[np.float32], values: NDArray[np.generic]) -> int:
        """Number of frames up to the one, if any, that casts doubt on the boundary."""
        likely = self._plausible_frames(temperature, values).tolist()
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
        """`TaxelStatus` of each reading, (k, n)."""
        with np.errstate(invalid="ignore"):
            good = (np.abs(field) <= MAX_FIELD_UT).all(axis=2)
            if "t" in self.layout.fields:
                good &= (temperature >= COLDEST_C) & (temperature <= HOTTEST_C)
        return np.where(good, TaxelStatus.OK, TaxelStatus.READ_FAILED).astype(np.uint8)

    def _search(self, buffer: bytes, at: int, whole_read: bool) -> int | None:
        """Offset of the first credible frame; None to wait for more data.

        Among overlapping candidates the best supported wins. Support comes from the frames after
        it, the end of a frame before it, and the end of the read if the buffer ends with it
        (``whole_read``).
        """
        size = self._size
        if self._bare:
            enough = len(buffer) - at >= LOCK_FRAMES * size and (len(buffer) - at) % size == 0
            return at if enough and self._count_frames(buffer, at) >= LOCK_FRAMES else None
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
            run = self._count_frames(buffer, start)
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
                continue  # a byte of the numbers may equal the end
            score = run + 0.5 * follows + 0.75 * closes
            if best is None or score > best[0]:
                best = score, start
        return None if best is None else best[1]

    def _count_frames(self, buffer: bytes, start: int) -> int:
        """Number of consecutive plausible frames from ``start`` on, up to a maximum."""
        most = 2 * LOCK_FRAMES if self._weak else LOCK_FRAMES
        whole = min((len(buffer) - start) // self._size, most)
        if not whole:
            return 0
        raw = np.frombuffer(buffer, np.uint8, whole * self._size, start).reshape(whole, -1)
        _, temperature, values = self._samples(raw)
        good = self._marked(raw) & self._plausible_frames(temperature, values)
        return whole if good.all() else int(good.argmin())
