"""How a board without a protocol writes its samples: kind of number, chips, order, framing.

A layout is written ``KIND:nFIELDS[,OPTION…]``, as in ``floats:5xyz`` or
``int16:5xyz,big,scale=0.15/0.242,start=aa55,check=sum``; PROTOCOL.md section 9 has the grammar.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from sensor_proto.packets import FloatSamples

MAX_CHIPS = 20
"""Four boards of five on one controller, the largest assembly on sale."""

MAX_EXTRA = 16
"""Bytes or numbers beside those of the chips that a frame may have."""

MAX_LINES = 64
"""Lines of text that one frame may take."""

STEPS_PER_K, RAW_AT_25_C = 45.2, 46244
"""T = 25 + (raw − 46244) / 45.2 °C, MLX90393 datasheet: temperatures of layouts of integers."""

COUNT_UT = (0.15, 0.15, 0.242)
"""µT for one count where a layout of integers does not say it: MLX90393 at gain 7, resolution 0."""

UNSIGNED_ZERO = 32768
"""Count of no field in ``uint16``."""

ENDS = {"crlf": b"\r\n", "lf": b"\n", "cr": b"\r", "none": b""}


class Kind(StrEnum):
    """How numbers are written."""

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
"""Kinds whose fields are counts of the chip."""

CHECKS = ("", "xor", "sum")
"""Checks of one byte over everything between ``start`` and the check."""

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
    """What stands round the numbers of a binary frame.

    ``start`` and ``end``: bytes that every frame has. ``skip``: bytes behind ``start`` that are not
    looked at, such as a counter. ``check``: one of `CHECKS`, behind the numbers. ``tail``: bytes
    behind the numbers (and the check) that are not looked at.
    """

    start: bytes = b""
    skip: int = 0
    check: str = ""
    tail: int = 0
    end: bytes = b""

    @property
    def extra(self) -> int:
        """Bytes beside the numbers."""
        return self.before + bool(self.check) + self.tail + len(self.end)

    @property
    def before(self) -> int:
        """Bytes before the numbers."""
        return len(self.start) + self.skip


@dataclass(frozen=True, slots=True)
class Layout:
    """One way to write the samples of ``chips`` magnetometers.

    ``fields``: letters x, y, z, t (each at most once; t may be left out) and _, in their order in
    each chip's numbers. ``scale``: µT for one unit of x, y, z. ``framing``: None for text, and for
    binary frames whose framing is to be found out. ``lead``: numbers before those of the first
    chip, ``lines``: lines a frame, both of text.
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
        """Layout as users write it; ValueError names what is allowed."""
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
        """The layout as users write it."""
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
        """Numbers of all chips in a frame."""
        return self.chips * len(self.fields)

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of a number in a binary frame."""
        return np.dtype((">" if self.big else "<") + _DTYPES[self.kind])

    @property
    def payload(self) -> int:
        """Bytes of the numbers of a binary frame."""
        return self.numbers * self.dtype.itemsize

    @property
    def size(self) -> int:
        """Bytes of a binary frame; its framing must be known."""
        return self.payload + (self.framing or Framing()).extra

    def samples(
        self, values: NDArray[np.generic]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Field (k, chips, 3) µT and temperature (k, chips) °C of (k, numbers) as written.

        NaN for temperatures that frames do not hold.
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
        """Frame of ``samples`` (one line of text, tabs between numbers), for simulated boards.

        ``number``: counts frames; its last byte is the first of the bytes that are skipped.
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
        if counted:  # what does not fit wraps, as in a chip's register
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
    """Byte that ``check`` gives for ``data``."""
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
        raise ValueError(f"{text!r} is not one to three numbers of µT, parted by /")
    xy, z = values[0], values[-1]
    return (xy, values[1] if len(values) == 3 else xy, z)
