"""Survey of a port whose frames are not known: infer the layout, or describe the bytes.

Frames repeat, so bytes one frame apart are often equal; bytes that are constant in every frame are
its start or end; numbers read with the wrong width, byte order or offset are absurd; and a
temperature can be told from a field (`layouts.evidence`). Where this leaves two readings, neither
is used and both are named.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sensor_proto.layouts import (
    COUNT_UT,
    MAX_CHIPS,
    MAX_LINES,
    Framing,
    Kind,
    Layout,
    Tokens,
    axis_of,
    check_of,
    join,
    tokens,
    with_or_without,
)

# Text lines: chips, order and labels, where they can be told.


LEAST_LINES = 4
"""Records of the same form needed to accept the form."""

MOST = 0.7
"""Fraction of the lines that must have it; banners and remarks come between."""

WEAKEST_UT = 15.0
"""Smallest credible median field in µT: the earth's is 22 to 67. Smaller numbers labelled x, y, z
come from something else, such as an accelerometer."""

UNITS_UT = {"ut": 1.0, "µt": 1.0, "mt": 1000.0, "gauss": 100.0, "g": 100.0}
"""µT per unit, for the units that sketches print after a number."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a survey.

    ``what``: the data in words. ``layout``: None unless it is certain. ``declare``: possible
    layouts, as ``--kind`` takes them.
    """

    layout: Layout | None
    what: str
    declare: tuple[str, ...] = ()


def read_text(data: bytes) -> Finding | None:
    """Assess the whole lines in ``data``; None if they hold no repeating numbers."""
    lines = [line for line in re.split(rb"[\r\n]+", data)[1:-1] if line.strip()]
    taken = [tokens(line) for line in lines]
    records, count = _records(taken)
    if len(records) < LEAST_LINES:
        return None
    numbers = len(records[0].numbers)
    values = np.array([r.numbers for r in records])
    lead, columns = _lead(values)
    return _find_in_text(records, values[:, lead:], lead, count, numbers, columns)


def _form(record: Tokens) -> tuple[int, tuple[bytes, ...]]:
    return len(record.numbers), tuple(b"".join(text.split()) for text in record.between)


def _records(taken: list[Tokens]) -> tuple[list[Tokens], int]:
    """Records of the most common form and their number of lines; empty for text without a form."""
    with_numbers = [t for t in taken if t.numbers]
    forms = Counter(_form(t) for t in with_numbers if not t.gone)
    if not forms:
        return [], 0
    usual, often = forms.most_common(1)[0]
    if often >= MOST * len(with_numbers):
        return [t for t in with_numbers if _form(t) == usual], 1
    seen = [_form(t) for t in with_numbers]
    for period in range(2, min(MAX_LINES, len(seen) // LEAST_LINES) + 1):
        same = sum(a == b for a, b in zip(seen, seen[period:], strict=False))
        if same < MOST * (len(seen) - period):
            continue
        named = Counter(f[1][0] for f in seen if axis_of(f[1][0]) in ("x", "t"))
        labels = sorted(label for label, n in named.items() if 2 * n >= max(named.values()))
        begins = [i for i, f in enumerate(seen) if not labels or f[1][0] == labels[0]]
        groups = [with_numbers[a:b] for a, b in itertools.pairwise(begins) if b - a == period]
        joined = [join(group) for group in groups]
        if not joined:
            continue
        usual = Counter(_form(r) for r in joined).most_common(1)[0][0]
        return [r for r in joined if _form(r) == usual], period
    return [], 0


def _lead(values: np.ndarray) -> tuple[int, int]:
    """Count of leading numbers (a growing clock or counter), and of those of the chips."""
    count = values.shape[1]
    first = values[:, 0]
    grows = bool((np.diff(first) > 0).all() and (first == np.round(first)).all())
    if grows and ((count - 1) % 3 == 0 or (count - 1) % 4 == 0) and count > 3:
        return 1, count - 1
    return 0, count


def _find_in_text(
    records: list[Tokens],
    values: np.ndarray,
    lead: int,
    lines: int,
    numbers: int,
    count: int,
) -> Finding | None:
    between = records[0].between[lead:]
    unit = _unit(between)

    def layout(fields: str) -> Layout:
        scale = (unit, unit, unit)
        return Layout(Kind.TEXT, count // len(fields), fields, scale=scale, lead=lead, lines=lines)

    every = f"{lines} lines" if lines > 1 else "lines"
    what = f"text, {every} of {numbers} numbers"
    labelled = _labelled([axis_of(text) for text in between[:-1]])
    if labelled and count // len(labelled) <= MAX_CHIPS:
        found = layout(labelled)
        field, _ = found.samples(values)
        if np.nanmedian(np.linalg.norm(field, axis=2)) < WEAKEST_UT:
            return Finding(
                None,
                f"{what} labelled {', '.join(labelled)}, too small for fields in µT",
                (str(found),),
            )
        return Finding(found, f"{what}, labelled {', '.join(labelled)}", (str(found),))
    if numbers < 3:
        return None
    grouped = _grouped(between, values)
    order = with_or_without(values)
    if grouped is not None:
        width, numbered = grouped
        plain = {"": "xyz", "_": "_xyz"} if width - numbered == 3 else {}
        if width - numbered == 4:
            chips = values.reshape(len(values), -1, width)[:, :, numbered:]
            four = with_or_without(chips.reshape(len(values), -1))
            plain = {"": four, "_": f"_{four}"} if four in ("txyz", "xyzt") else {}
        fields = plain.get("_" if numbered else "")
        if fields and count // width <= MAX_CHIPS:
            found = layout(fields)
            return Finding(found, f"{what} in groups of {width}", (str(found),))
    if order in ("txyz", "xyzt") and count // 4 <= MAX_CHIPS:
        found = layout(order)
        return Finding(found, f"{what}, {count // 4} chips with temperatures", (str(found),))
    fits = [f for f in ("txyz", "xyz") if count % len(f) == 0 and count // len(f) <= MAX_CHIPS]
    if order == "xyz":
        fits = ["xyz"]
        what += ", no temperatures and no labels among them"
    elif len(fits) == 2:
        what += f": {count // 4} chips with temperatures, or {count // 3} without"
    elif fits == ["txyz"]:
        fits = ["txyz", "xyzt"]
    return Finding(None, what, tuple(str(layout(f)) for f in fits))


def _labelled(axes: list[str]) -> str:
    """Fields per chip if every number has a label, the same for all chips; otherwise empty."""
    for width in (3, 4):
        fields = "".join(axes[:width])
        whole = len(axes) % width == 0 and axes == list(fields) * (len(axes) // width)
        if whole and sorted(fields) in (["x", "y", "z"], ["t", "x", "y", "z"]):
            return fields
    return ""


def _unit(between: tuple[bytes, ...]) -> float:
    """µT per unit, for the unit printed after the first number; 1 if there is none."""
    match = re.match(rb"\s*([A-Za-z\xc2\xb5]+)", between[1])
    word = match[1].decode("utf-8", "replace").lower() if match else ""
    return UNITS_UT.get(word, 1.0)


def _grouped(
    between: tuple[bytes, ...],
    values: np.ndarray,
) -> tuple[int, int] | None:
    """Numbers per group, and how many of them (0 or 1) only number the chips.

    Groups are recognised by separators that differ between and within groups; None without groups.
    """
    inner = [b"".join(re.split(rb"[0-9]+", text.strip(b" "))) for text in between[1:-1]]
    count = values.shape[1]
    for width in (3, 4, 5):
        if count % width or count == width:
            continue
        inside = {m for i, m in enumerate(inner) if (i + 1) % width}
        outside = {m for i, m in enumerate(inner) if (i + 1) % width == 0}
        if len(inside) == 1 and len(outside) == 1 and inside != outside:
            chips = values.reshape(len(values), -1, width)
            index = chips[:, :, 0]
            steps = np.arange(index.shape[1])
            numbered = any((index == steps + base).all() for base in (0, 1))
            return width, int(numbered)
    return None


KEEP = 8192
"""Bytes assessed: six of the longest frames, or some of the widest lines of text."""

LEAST_FRAMES = 6
"""Repeating frames needed."""

ROWS = 8
"""Frames compared. A larger number would more often include one with lost bytes."""

LONGEST = MAX_CHIPS * 4 * 8 + 32
"""Size of the longest frame in bytes: doubles of the largest board."""

REPEATS = 0.2
"""Fraction of equal bytes at the distance of a frame; in noise it is 1/256."""

ALMOST = 0.85
"""Fraction of the best share that the right distance reaches if the best is a multiple of it."""

STARTS = tuple(
    bytes.fromhex(word)
    for word in (
        *("aa55", "55aa", "a55a", "5aa5", "ffff", "fefe", "eb90", "aaaa", "5555", "a5a5"),
        *("aa", "55", "a5", "5a", "ff", "fe", "02", "24", "3c", "7e"),
    )
)
"""Common first bytes of frames."""

MOSTLY = 0.9
"""Fraction of printable characters that makes it text."""

MOST_COUNTS = 1 << 20
"""Limit of credible 32-bit counts: the chips give no larger ones, and pairs of 16-bit integers read
as one nearly always do."""

UNSIGNED_FROM = 24_000
"""Median size from which 16-bit integers are taken as unsigned."""

MOST_UT, LEAST_UT = 1e5, 1e-3
"""Range of credible sizes of floats in µT; 0 is credible too."""

_PRINTABLE = np.zeros(256, bool)
_PRINTABLE[32:127] = True
_PRINTABLE[[9, 10, 13, 0xB0, 0xB5, 0xC2]] = True


@dataclass(frozen=True, slots=True)
class _Frame:
    """Repeating frames, (k, size) bytes. Each row is one frame as far as ``framing`` tells."""

    rows: NDArray[np.uint8]
    framing: Framing

    @property
    def size(self) -> int:
        return int(self.rows.shape[1])

    def body(self, layout: Layout) -> NDArray[np.generic]:
        before = self.framing.before
        cut = np.ascontiguousarray(self.rows[:, before : before + layout.payload])
        return cut.view(layout.dtype)


class Survey:
    """Keeps the last bytes of a port and assesses them.

    ``declared``: the layout that the user declared.
    """

    def __init__(self, declared: Layout | None = None) -> None:
        self._declared = declared
        self.reset()

    def reset(self) -> None:
        """Forget all bytes."""
        self._data = b""

    def feed(self, data: bytes) -> None:
        """Add the bytes of one read."""
        self._data = (self._data + data)[-KEEP:]

    @property
    def full(self) -> bool:
        """Whether as many bytes were received as are assessed."""
        return len(self._data) >= KEEP

    def judge(self) -> Finding | None:
        """Assess the bytes; None if nothing repeats, or too little was received yet."""
        values = np.frombuffer(self._data, np.uint8)
        declared = self._declared
        if not len(values):
            return None
        if declared is not None and declared.kind is not Kind.TEXT:
            placed = self._fit_declared(values, declared)
            if placed is not None:
                return placed
        found = self._judge_undeclared(values)
        if declared is None or found is None:
            return found
        other = [layout for layout in found.declare if layout != str(declared)]
        return Finding(None, f"{found.what}, not {declared} as declared", tuple(other))

    def _judge_undeclared(self, values: NDArray[np.uint8]) -> Finding | None:
        """Assess the bytes without the declared layout."""
        if _PRINTABLE[values].mean() >= MOSTLY:
            return read_text(self._data)
        size = _period(values, None)
        if size is None:
            return None
        rows = _rows(values, size)
        return None if (rows == rows[0, 0]).all() else _find_numbers(rows)

    def _fit_declared(self, values: NDArray[np.uint8], declared: Layout) -> Finding | None:
        """Find the framing around the declared numbers; None if they do not fit anywhere."""
        size = _period(values, declared.payload)
        if size is None:
            return None
        rows = _rows(values, size)
        if (rows == rows[0, 0]).all():
            return None
        for frame in _possible_frames(rows):
            for around in _variants(frame, declared.payload):
                whole = replace(declared, framing=around.framing)
                if whole.size == frame.size and _plausible(whole, around.body(whole)):
                    return Finding(whole, _describe(around, f"{declared.numbers} {declared.kind}"))
        return None


def _period(values: NDArray[np.uint8], payload: int | None) -> int | None:
    """Distance at which bytes are most often equal, in bytes; None if nothing repeats."""
    recent = values[-4 * LONGEST :] if len(values) > 4 * LONGEST else values
    longest = min(LONGEST, len(recent) // LEAST_FRAMES)
    if longest < 8:
        return None
    share = np.zeros(longest + 1)
    for size in range(6, longest + 1):
        share[size] = np.count_nonzero(recent[size:] == recent[:-size]) / (len(recent) - size)
    if payload is not None:
        share[: min(payload, longest + 1)] = 0.0
    best = int(share.argmax())
    if share[best] < REPEATS:
        return None
    for parts in range(best // 6, 1, -1):
        if best % parts == 0 and share[best // parts] >= ALMOST * share[best]:
            return best // parts
    return best


def _rows(values: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """The most similar consecutive frames, (k, size); others may have lost bytes.

    They end where a read may have ended: a whole number of frames before the last byte.
    """
    count = min(ROWS, len(values) // size)
    same = np.concatenate([[0], np.cumsum(values[size:] == values[:-size])])
    ends = np.arange(len(values), count * size - 1, -size)
    alike = same[ends - size] - same[ends - count * size]
    end = int(ends[alike.argmax()])
    return values[end - count * size : end].reshape(count, size)


def _possible_frames(rows: NDArray[np.uint8]) -> list[_Frame]:
    """Frames cut at every possible start or end, the most significant first."""
    still = (rows == rows[0]).all(axis=0)
    modes = rows[0]
    size = rows.shape[1]
    out: list[tuple[int, bool, _Frame]] = []  # significance, and whether it splits a read

    def cut(at: int) -> NDArray[np.uint8]:
        """Rows that begin at column ``at``; wrapping costs one frame."""
        flat = rows.reshape(-1)[at : at + (len(rows) - 1) * size] if at else rows.reshape(-1)
        return flat.reshape(-1, size)

    def stands(word: bytes, at: int) -> bool:
        places = [(at + i) % size for i in range(len(word))]
        return all(still[p] and modes[p] == b for p, b in zip(places, word, strict=True))

    ends = [(b"\r\n", at) for at in range(size) if stands(b"\r\n", at)]
    if not ends:
        ends = [(b"\n", at) for at in range(size) if stands(b"\n", at)]
    starts = [(word, at) for word in STARTS for at in range(size) if stands(word, at)]
    for end, at in ends:
        begin = (at + len(end)) % size
        framed = [w for w, s in starts if s == begin and len(w) == 2]
        if framed:
            both = Framing(start=framed[0], end=end)
            out.append((len(end) + 2, begin > 0, _Frame(cut(begin), both)))
        out.append((len(end), begin > 0, _Frame(cut(begin), Framing(end=end))))
    out += [(len(word), at > 0, _Frame(cut(at), Framing(start=word))) for word, at in starts]
    out.sort(key=lambda item: (-item[0], item[1]))
    return [frame for *_, frame in out[:40]] + [_Frame(rows, Framing())]


def _variants(frame: _Frame, payload: int | None = None) -> list[_Frame]:
    """Variants of a frame with leading and trailing bytes that are not numbers excluded."""
    rows, plain = frame.rows, frame.framing
    room = frame.size - len(plain.start) - len(plain.end)
    begin = len(plain.start)
    marked = bool(plain.start or plain.end)
    out: list[_Frame] = []
    for skip in range(5 if marked else 1):
        if skip and not _constant_or_counting(rows[:, begin : begin + skip]):
            break
        for tail in range(3 if marked else 1):
            if payload is not None and room - skip - tail != payload:
                continue
            if room - skip - tail < 6:
                continue
            framing = replace(plain, skip=skip, tail=tail)
            place = frame.size - len(plain.end) - 1
            if tail == 1:
                for check in ("xor", "sum"):
                    if all(check_of(check, r[begin:place].tobytes()) == r[place] for r in rows):
                        framing = replace(plain, skip=skip, check=check)
                        break
            out.append(_Frame(rows, framing))
    # The best explained variants come first.
    out.sort(key=lambda f: (f.framing.tail, f.framing.skip if not f.framing.check else 0))
    return out


def _constant_or_counting(columns: NDArray[np.uint8]) -> bool:
    """Whether every column is constant or counts frames."""
    for column in columns.T:
        steps = np.diff(column.astype(np.int16)) % 256
        if not ((steps == 0).all() or (steps == 1).all()):
            return False
    return True


def _plausible(layout: Layout, values: NDArray[np.generic]) -> bool:
    """Whether the numbers are credible for a board."""
    if layout.kind in (Kind.FLOATS, Kind.DOUBLES):
        return _plausible_floats(values)
    return True


def _plausible_floats(values: NDArray[np.generic]) -> bool:
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.abs(values.astype(np.float64))
        good = (size <= MOST_UT) & ((size >= LEAST_UT) | (size == 0))
        return bool(good.mean() >= 0.97 and (size > 0).any())


def _find_numbers(rows: NDArray[np.uint8]) -> Finding | None:
    """Assess frames with the first kind of number that makes sense."""
    frames = _possible_frames(rows)
    for kind, big in ((Kind.FLOATS, False), (Kind.DOUBLES, False), (Kind.FLOATS, True)):
        for frame in frames:
            for around in _variants(frame):
                framing = around.framing
                probe = Layout(kind, 1, "xyz", big=big)
                room = around.size - framing.extra
                count, rest = divmod(room, probe.dtype.itemsize)
                if rest or count < 3:
                    continue
                probe = replace(probe, fields="x" * count)
                values = around.body(probe)
                if _plausible_floats(values):
                    return _describe_floats(around, kind, big, values)
    return _find_counts(frames)


def _describe_floats(frame: _Frame, kind: Kind, big: bool, values: NDArray[np.generic]) -> Finding:
    count = values.shape[1]
    framing = frame.framing
    order = with_or_without(np.asarray(values, np.float64))
    name = "floats" if kind is Kind.FLOATS else "doubles"
    number = f"{count} {'big-endian ' if big else ''}{name}"
    marked = framing.start or framing.end or framing.check
    # A framing that the survey would find again need not be declared.
    declared = framing if framing.tail or not marked else None

    def layout(fields: str) -> Layout:
        return Layout(kind, count // len(fields), fields, big, framing=declared)

    fits = [f for f in ("txyz", "xyz") if count % len(f) == 0 and count // len(f) <= MAX_CHIPS]
    if order in ("txyz", "xyzt") and count // 4 <= MAX_CHIPS:
        what = _describe(frame, f"{number}, {count // 4} chips with temperatures")
        plain = marked and not framing.tail
        whole = replace(layout(order), framing=framing)
        return Finding(whole if plain else None, what, (str(layout(order)),))
    if order == "xyz" and "xyz" in fits:
        return Finding(None, _describe(frame, f"{number}, no temperatures"), (str(layout("xyz")),))
    if len(fits) == 2:
        what = f"{number}: {count // 4} chips with temperatures, or {count // 3} without"
        return Finding(None, _describe(frame, what), tuple(str(layout(f)) for f in fits))
    if fits == ["txyz"]:
        fits = ["txyz", "xyzt"]
    return Finding(None, _describe(frame, number), tuple(str(layout(f)) for f in fits))


def _find_counts(frames: list[_Frame]) -> Finding | None:
    """Assess frames of integers.

    They have 32 bits if they are small, otherwise 16 bits in the byte order that varies least.
    """
    wide = _find_wide_counts(frames)
    if wide is not None:
        return wide
    best: tuple[float, _Frame, bool, int] | None = None
    for frame in frames:
        for around in _variants(frame):
            framing = around.framing
            count, rest = divmod(around.size - framing.extra, 2)
            if rest or count < 3 or (count % 3 and count % 4):
                continue
            moves = []
            for big in (False, True):
                probe = Layout(Kind.INT16, 1, "x" * count, big)
                counts = around.body(probe).astype(np.int32)
                steps = counts[1:] - counts[:-1]
                moves.append(float(np.abs((steps + 32768) % 65536 - 32768).mean()) + 0.5)
            little, large = moves
            ratio = max(little, large) / min(little, large)
            telling = ratio * (4 if framing.check else 1) * (2 if not framing.tail else 1)
            if ratio > 4 and (best is None or telling > best[0] * 1.5):
                best = telling, around, large < little, count
    if best is None:
        if not frames[0].framing.start and not frames[0].framing.end:
            return None
        return Finding(None, _describe(frames[0], "numbers of a kind that is not known"))
    _, frame, big, count = best
    values = frame.body(Layout(Kind.INT16, 1, "x" * count, big)).astype(np.int32)
    # Values around 32768 come from a converter with unsigned output.
    kind = Kind.UINT16 if float(np.median(np.abs(values))) > UNSIGNED_FROM else Kind.INT16
    return _describe_counts(frame, kind, big, count)


def _find_wide_counts(frames: list[_Frame]) -> Finding | None:
    """Assess frames of 32-bit integers: all are small, which pairs of 16-bit integers never are."""
    for frame in frames:
        for around in _variants(frame):
            count, rest = divmod(around.size - around.framing.extra, 4)
            if rest or count < 3 or (count % 3 and count % 4):
                continue
            for big in (False, True):
                values = around.body(Layout(Kind.INT32, 1, "x" * count, big)).astype(np.int64)
                if np.abs(values).max() < MOST_COUNTS and np.abs(values).max() > 1:
                    return _describe_counts(around, Kind.INT32, big, count)
    return None


def _describe_counts(frame: _Frame, kind: Kind, big: bool, count: int) -> Finding:
    fits = [f for f in ("txyz", "xyz") if count % len(f) == 0 and count // len(f) <= MAX_CHIPS]
    declared = [str(Layout(kind, count // len(f), f, big, COUNT_UT, frame.framing)) for f in fits]
    order = "big-endian" if big else "little-endian"
    words = {Kind.INT32: "32-bit integers", Kind.UINT16: "16-bit integers without sign"}
    numbers = f"{count} {order} {words.get(kind, '16-bit integers')}"
    return Finding(None, _describe(frame, numbers), tuple(declared))


def _describe(frame: _Frame, numbers: str) -> str:
    """Describe frames in words."""
    framing = frame.framing
    words = []
    if framing.start:
        words.append("beginning with " + framing.start.hex(" ").upper())
    if framing.end:
        name = {b"\r\n": "CR LF", b"\n": "LF", b"\r": "CR"}.get(framing.end)
        words.append(f"ending in {name or framing.end.hex(' ').upper()}")
    if not words and not framing.check:
        words.append("with neither start nor end")
    if framing.check:
        words.append(f"with a check ({framing.check})")
    if framing.tail:
        words.append(f"with {framing.tail} bytes behind the numbers that may be a check")
    return f"frames of {frame.size} bytes {' and '.join(words)}: {numbers}"
