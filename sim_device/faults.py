"""Fault plan of a board, parsed from text: what goes wrong, when and how often. Seeded."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum

from tactile_core.config import ConfigError

DELAY_S = 0.02
"""Seconds that a delayed frame holds up the line by default: two samples at 100 Hz."""


@dataclass(frozen=True, slots=True)
class Window:
    """From ``start`` s after power-on, for ``duration`` s (inf: to the end)."""

    start: float
    duration: float = math.inf

    def covers(self, seconds: float) -> bool:
        """Whether the instant ``seconds`` s after power-on lies inside."""
        return self.start <= seconds < self.start + self.duration


class TaxelFaultKind(StrEnum):
    """What a broken taxel does."""

    STUCK = "stuck"  # repeats its value, unflagged: a chip that stopped converting
    SATURATED = "saturated"  # full scale, flagged
    FAILED = "failed"  # does not answer the bus: flagged, the counts mean nothing
    ZEROS = "zeros"  # a failed read sent as zeros, temperature too, unflagged
    ONES = "ones"  # a failed read sent as minus one on every axis, unflagged
    RAIL = "rail"  # z at the end of its range, unflagged
    WRAP = "wrap"  # z close to the end of its range: a press makes it wrap around
    JUMP = "jump"  # far from where it was, on every axis
    TWIN = "twin"  # the bits of the chip before it (chip 0: of chip 1)
    DITHER = "dither"  # stuck but for the last bits, which toggle
    HOT = "hot"  # its thermometer reads 99 °C
    LOOSE = "loose"  # its magnet has come off
    INFINITE = "inf"  # infinities and NaN; only boards that send floats


ALL_TAXELS = -1
"""Taxel number that stands for every taxel of an array."""


@dataclass(frozen=True, slots=True)
class TaxelFault:
    """Taxel number ``taxel`` of ``array`` is broken while ``window`` lasts.

    ``share``: share of its readings affected, drawn at random.
    """

    kind: TaxelFaultKind
    array: str
    taxel: int
    window: Window
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """All faults of one board and its wire. ValueError for probabilities outside 0 to 1.

    ``flip`` is per bit, ``byteloss`` and ``byteinsert`` per byte, the other probabilities per
    frame. ``delay_s``: how long a delayed frame holds up the line. ``gain``: factors of all counts;
    ``leap``: µT added to the field; each with its window.
    """

    seed: int = 0
    flip: float = 0.0
    byteloss: float = 0.0
    byteinsert: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    splice: float = 0.0
    delay: float = 0.0
    delay_s: float = DELAY_S
    silence: tuple[Window, ...] = ()
    reset: tuple[float, ...] = ()
    busoff: tuple[Window, ...] = ()
    copy: tuple[Window, ...] = ()
    skinoff: tuple[Window, ...] = ()
    newskin: tuple[Window, ...] = ()
    gain: tuple[tuple[float, Window], ...] = ()
    leap: tuple[tuple[float, Window], ...] = ()
    taxels: tuple[TaxelFault, ...] = ()

    def __post_init__(self) -> None:
        """Check ranges; ValueError."""
        for name in PROBABILITIES:
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"{name} is a probability from 0 to 1, not {value!r}")
        if not 0 <= self.delay_s < math.inf:
            raise ValueError(f"delay_s is a time of at least 0 s, not {self.delay_s!r}")

    @classmethod
    def parse(cls, text: str) -> FaultPlan:
        """Plan from text such as ``flip=1e-5,loss=0.01,silence@5s+2s,reset@8s,stuck=left:3@2s``.

        Entries, separated by commas: ``seed=N``; ``NAME=PROBABILITY`` for flip, byteloss,
        byteinsert, loss, duplicate, reorder, splice; ``delay=PROBABILITY:SECONDSs``;
        ``silence@Ts+Ds``, ``busoff@Ts+Ds``, ``copy@Ts+Ds``, ``reset@Ts``; ``skinoff@Ts+Ds``,
        ``newskin@Ts``, ``gain=FACTOR@Ts+Ds``, ``leap=MICROTESLA@Ts+Ds``; a `TaxelFaultKind`
        such as ``zeros=ARRAY:TAXEL`` (``*``: every taxel) with an optional ``:SHARE`` of its
        readings and an optional ``@Ts`` or ``@Ts+Ds`` (``nan`` is ``failed``). ConfigError names
        the entry and what is allowed.
        """
        entries = [e.strip() for e in text.split(",")]
        return _collect([e for e in entries if e])

    @property
    def touches_wire(self) -> bool:
        """Whether the plan has faults of the wire."""
        return bool(self.silence) or any(getattr(self, name) > 0 for name in PROBABILITIES)


PROBABILITIES = (
    "flip",
    "byteloss",
    "byteinsert",
    "loss",
    "duplicate",
    "reorder",
    "splice",
    "delay",
)
_TAXEL_FAULTS = {**{kind.value: kind for kind in TaxelFaultKind}, "nan": TaxelFaultKind.FAILED}
TIMED = ("silence", "reset", "busoff", "copy", "skinoff", "newskin")
STARTING = ("reset", "newskin")
"""Faults that have a start but no end."""
SIZED = ("gain", "leap")
"""Faults with a value, then a time: ``gain=FACTOR@Ts+Ds``, ``leap=MICROTESLA@Ts+Ds``."""

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_ENTRY = re.compile(r"(?P<name>[a-z_]+)\s*(?P<mark>[=@])\s*(?P<rest>.+)")
_DELAY = re.compile(rf"(?P<p>{_NUMBER})\s*(?::\s*(?P<s>{_NUMBER})\s*s)?")
_WINDOW = re.compile(rf"(?P<at>{_NUMBER})\s*s\s*(?:\+\s*(?P<for>{_NUMBER})\s*s)?")
_TAXEL = re.compile(
    rf"(?P<array>[A-Za-z0-9_-]+):(?P<taxel>\d{{1,4}}|\*)(?:\s*:\s*(?P<share>{_NUMBER}))?"
    rf"\s*(?:@\s*(?P<window>{_NUMBER}\s*s.*))?"
)
_FORMS = (
    "allowed: seed=N; flip, byteloss, byteinsert, loss, duplicate, reorder, splice = probability "
    "from 0 to 1; delay=PROBABILITY:SECONDSs; silence@Ts+Ds; busoff@Ts+Ds; copy@Ts+Ds; "
    "reset@Ts; skinoff@Ts+Ds; newskin@Ts; gain=FACTOR@Ts+Ds; leap=MICROTESLA@Ts+Ds; "
    f"{', '.join(TaxelFaultKind)} (or nan: failed) = ARRAY:TAXEL:SHARE@Ts+Ds"
)


def _collect(entries: list[str]) -> FaultPlan:
    figures: dict[str, float] = {}
    seed: int | None = None
    windows: dict[str, list[Window]] = {name: [] for name in TIMED}
    sized: dict[str, list[tuple[float, Window]]] = {name: [] for name in SIZED}
    taxels: list[TaxelFault] = []
    for entry in entries:
        label = f"fault {entry!r}"
        match = _ENTRY.fullmatch(entry)
        if match is None:
            raise ConfigError(f"{label} is not understood; {_FORMS}")
        name, mark, rest = match["name"], match["mark"], match["rest"].strip()
        if name in TIMED and mark == "@":
            windows[name].append(
                _window(rest, label, needs_end=name not in STARTING, may_end=name not in STARTING)
            )
        elif mark != "=":
            raise ConfigError(f"{label} is not understood; {_FORMS}")
        elif name in _TAXEL_FAULTS:
            taxels.append(_taxel_fault(_TAXEL_FAULTS[name], rest, label))
        elif name in SIZED:
            sized[name].append(_sized(rest, label))
        elif name in figures or (name == "seed" and seed is not None):
            raise ConfigError(f"{label}: {name} is given twice; give it once")
        elif name == "seed":
            if not rest.isdecimal():
                raise ConfigError(f"{label}: allowed: a whole number of at least 0")
            seed = int(rest)
        elif name == "delay":
            figures |= _delay(rest, label)
        elif name in PROBABILITIES:
            figures[name] = _probability(rest, label)
        else:
            raise ConfigError(f"{label} is not understood; {_FORMS}")
    chance = {name: figures.get(name, 0.0) for name in PROBABILITIES}
    return FaultPlan(
        seed=seed or 0,
        flip=chance["flip"],
        byteloss=chance["byteloss"],
        byteinsert=chance["byteinsert"],
        loss=chance["loss"],
        duplicate=chance["duplicate"],
        reorder=chance["reorder"],
        splice=chance["splice"],
        delay=chance["delay"],
        delay_s=figures.get("delay_s", DELAY_S),
        silence=tuple(windows["silence"]),
        reset=tuple(w.start for w in windows["reset"]),
        busoff=tuple(windows["busoff"]),
        copy=tuple(windows["copy"]),
        skinoff=tuple(windows["skinoff"]),
        newskin=tuple(windows["newskin"]),
        gain=tuple(sized["gain"]),
        leap=tuple(sized["leap"]),
        taxels=tuple(taxels),
    )


def _probability(text: str, label: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise ConfigError(f"{label}: allowed: a probability from 0 to 1")
    return value


def _delay(text: str, label: str) -> dict[str, float]:
    match = _DELAY.fullmatch(text)
    if match is None:
        raise ConfigError(f"{label}: allowed: PROBABILITY:SECONDSs, such as 0.01:0.02s")
    plan = {"delay": _probability(match["p"], label)}
    if match["s"]:
        plan["delay_s"] = float(match["s"])
    return plan


def _sized(text: str, label: str) -> tuple[float, Window]:
    figure, mark, when = text.partition("@")
    try:
        value = float(figure)
    except ValueError:
        value = math.nan
    if not mark or not 0 < value < 1e5:
        raise ConfigError(
            f"{label}: allowed: a figure above 0, then @Ts or @Ts+Ds, such as gain=1.67@4s (factor "
            "of all counts) or leap=2000@4s+2s (µT)"
        )
    return value, _window(when, label, needs_end=False, may_end=True)


def _window(text: str, label: str, needs_end: bool, may_end: bool) -> Window:
    match = _WINDOW.fullmatch(text)
    if match is None or (needs_end and not match["for"]) or (match["for"] and not may_end):
        form = "Ts+Ds" if needs_end else "Ts or Ts+Ds" if may_end else "Ts"
        raise ConfigError(f"{label}: allowed: {form}, seconds after power-on, such as 5s+2s or 5s")
    return Window(float(match["at"]), float(match["for"]) if match["for"] else math.inf)


def _taxel_fault(kind: TaxelFaultKind, text: str, label: str) -> TaxelFault:
    match = _TAXEL.fullmatch(text)
    if match is None:
        raise ConfigError(
            f"{label}: allowed: ARRAY:TAXEL (* for all), then :SHARE of its readings, then @Ts or "
            "@Ts+Ds, such as left:3@2s+5s or skin:*:0.05@4s"
        )
    share = float(match["share"]) if match["share"] else 1.0
    if not 0 < share <= 1:
        raise ConfigError(f"{label}: allowed: a SHARE above 0 and up to 1")
    window = (
        _window(match["window"], label, needs_end=False, may_end=True)
        if match["window"]
        else Window(0.0)
    )
    taxel = ALL_TAXELS if match["taxel"] == "*" else int(match["taxel"])
    return TaxelFault(kind, match["array"], taxel, window, share)
