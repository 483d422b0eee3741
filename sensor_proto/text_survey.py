"""What lines of text hold: chips, order and labels, where they can be told."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from dataclasses import dataclass

import numpy as np

from sensor_proto.layout import MAX_CHIPS, MAX_LINES, Kind, Layout
from sensor_proto.temperature import with_or_without
from sensor_proto.text_frames import Tokens, axis_of, join, tokens

LEAST_LINES = 4
"""Records of the same form from which a form is believed."""

MOST = 0.7
"""Share of the lines that must have it: banners and remarks come between."""

WEAKEST_UT = 15.0
"""µT: the earth's field is 22 to 67; numbers labelled x, y, z that stay below are of something
else, such as an accelerometer."""

UNITS_UT = {"ut": 1.0, "µt": 1.0, "mt": 1000.0, "gauss": 100.0, "g": 100.0}
"""µT for one of the units that sketches print behind a number."""


@dataclass(frozen=True, slots=True)
class TextFinding:
    """See `survey.Finding`."""

    layout: Layout | None
    what: str
    declare: tuple[str, ...] = ()


def read_text(data: bytes) -> TextFinding | None:
    """What whole lines in ``data`` are; None: no numbers that repeat."""
    lines = [line for line in re.split(rb"[\r\n]+", data)[1:-1] if line.strip()]
    taken = [tokens(line) for line in lines]
    records, count = _records(taken)
    if len(records) < LEAST_LINES:
        return None
    numbers = len(records[0].numbers)
    values = np.array([r.numbers for r in records])
    lead, columns = _lead(values)
    return _of(records, values[:, lead:], lead, count, numbers, columns)


def _form(record: Tokens) -> tuple[int, tuple[bytes, ...]]:
    return len(record.numbers), tuple(b"".join(text.split()) for text in record.between)


def _records(taken: list[Tokens]) -> tuple[list[Tokens], int]:
    """Records of the usual form, and the lines that one takes; none for text without form."""
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
    """Numbers before those of the chips: a clock or counter that only grows; and those left."""
    count = values.shape[1]
    first = values[:, 0]
    grows = bool((np.diff(first) > 0).all() and (first == np.round(first)).all())
    if grows and ((count - 1) % 3 == 0 or (count - 1) % 4 == 0) and count > 3:
        return 1, count - 1
    return 0, count


def _of(
    records: list[Tokens],
    values: np.ndarray,
    lead: int,
    lines: int,
    numbers: int,
    count: int,
) -> TextFinding | None:
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
            return TextFinding(
                None,
                f"{what} labelled {', '.join(labelled)}, too small for fields in µT",
                (str(found),),
            )
        return TextFinding(found, f"{what}, labelled {', '.join(labelled)}", (str(found),))
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
            return TextFinding(found, f"{what} in groups of {width}", (str(found),))
    if order in ("txyz", "xyzt") and count // 4 <= MAX_CHIPS:
        found = layout(order)
        return TextFinding(found, f"{what}, {count // 4} chips with temperatures", (str(found),))
    fits = [f for f in ("txyz", "xyz") if count % len(f) == 0 and count // len(f) <= MAX_CHIPS]
    if order == "xyz":
        fits = ["xyz"]
        what += ", no temperatures and no labels among them"
    elif len(fits) == 2:
        what += f": {count // 4} chips with temperatures, or {count // 3} without"
    elif fits == ["txyz"]:
        fits = ["txyz", "xyzt"]
    return TextFinding(None, what, tuple(str(layout(f)) for f in fits))


def _labelled(axes: list[str]) -> str:
    """Fields of a chip where every number has a label, the same for all chips; else empty."""
    for width in (3, 4):
        fields = "".join(axes[:width])
        whole = len(axes) % width == 0 and axes == list(fields) * (len(axes) // width)
        if whole and sorted(fields) in (["x", "y", "z"], ["t", "x", "y", "z"]):
            return fields
    return ""


def _unit(between: tuple[bytes, ...]) -> float:
    """µT for the unit printed behind the first number, 1 where none is."""
    match = re.match(rb"\s*([A-Za-z\xc2\xb5]+)", between[1])
    word = match[1].decode("utf-8", "replace").lower() if match else ""
    return UNITS_UT.get(word, 1.0)


def _grouped(
    between: tuple[bytes, ...],
    values: np.ndarray,
) -> tuple[int, int] | None:
    """Numbers of a group where other marks stand between groups than within, and how many of them
    only number the chips (0 or 1); None where no groups are to be seen."""
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
