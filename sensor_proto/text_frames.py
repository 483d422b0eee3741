"""Lines of text to samples: what numbers a line holds, and lines of a known layout.

Sketches print their numbers with tabs, commas or blanks between them, with labels such as ``X0:``
or none, sometimes with nothing at all between two numbers of two decimals each.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensor_proto.decoder import ACCEPTED, Reject, Tally
from sensor_proto.layout import Kind, Layout
from sensor_proto.packets import FloatSamples, Received, TaxelStatus
from sensor_proto.temperature import COLDEST_C, HOTTEST_C

MAX_LINE = 4096
"""Bytes of a line; a longer one is none."""

MAX_FIELD_UT = 1e6

FORGET_AFTER = 20
"""Lines in a row that do not fit after which decimals are learnt anew: firmware was replaced."""

_END = re.compile(rb"[\r\n]+")
_MISSING = rb"(?:nan|inf|ovf|null|none|err(?:or)?|fail(?:ed)?)(?![A-Za-z])"
_WORD = rb"[A-Za-z_\xc2\xb5\xb0][A-Za-z0-9_\xc2\xb5\xb0]*"
_NUMBER = rb"[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?"
_TOKEN = re.compile(rb"(?P<gone>[-+]?%s)|(?P<word>%s)|(?P<number>%s)" % (_MISSING, _WORD, _NUMBER),
                    re.IGNORECASE)  # fmt: skip
_GLUED = re.compile(rb"[0-9]\.[0-9]+\.[0-9]")


@dataclass(frozen=True, slots=True)
class Tokens:
    """Numbers of a record. ``between``: text before each number and behind the last, words and all.

    ``decimals``: of each number, −1 for one that is no number (nan, ERR) and stands for a reading
    that failed.
    """

    numbers: tuple[float, ...]
    decimals: tuple[int, ...]
    between: tuple[bytes, ...]

    @property
    def gone(self) -> int:
        """How many are no numbers."""
        return self.decimals.count(-1)


def tokens(line: bytes) -> Tokens:
    """Take a line apart. Numbers with nothing between them are told by their equal decimals."""
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
    """One record of several lines."""
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
    """Axis that the text before a number names: x, y, z, t (temperature), or empty for none."""
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
    """Lines of ``layout`` (numbers of all chips, in order) to `FloatSamples`.

    Whatever stands between the numbers is passed over; how many decimals each has is learnt from
    the first lines and demanded of the others, so that a line with a piece missing is dropped.
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
        """Lines accepted (frames), times their form was lost, bytes of lines that did not fit."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget the unfinished line and what was learnt."""
        self._buffer = b""
        self._whole = False  # whether a line has been seen to begin
        self._record: list[Tokens] = []
        self._record_bytes = 0
        self._form: tuple[tuple[int, ...], int] | None = None
        self._wrong = 0
        self._label = b""  # before the first number of a frame of several lines

    def feed(self, data: bytes, /) -> list[Received]:
        """Frames that ``data`` completed."""
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
                return  # a rule between two frames
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
        numbers = self._fitting(part)
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
        """Whether a line is the first of a frame: it names the first axis, of the first chip.

        Where lines name no axis, any line may be.
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

    def _fitting(self, part: Tokens) -> tuple[float, ...] | None:
        """Numbers of a record that has as many as the layout, in the form learnt; else None."""
        numbers, decimals = part.numbers, part.decimals
        missing = self._wanted - len(numbers)
        if missing > 0 and part.gone and missing % part.gone == 0:
            each = 1 + missing // part.gone  # one word in the place of a chip's numbers
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
        if seen < 2:  # the first line may have been the odd one
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
