"""The questions of ``tactile calibrate record``, and what is labelled with the answers.

Pure but for what it is given: words are asked and said through functions, frames come from a
`Source`, labels go to a `Sink`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from tactile_tools.calibrate.csv_pair import NEWTON_PER_GRAM_FORCE

MAX_FORCE_N = 1000.0
FORCE = re.compile(r"([0-9]*[.,]?[0-9]+)\s*(n|g|kg|)", re.IGNORECASE)
NEWTON = {"n": 1.0, "": 1.0, "g": NEWTON_PER_GRAM_FORCE, "kg": 1000 * NEWTON_PER_GRAM_FORCE}
LEAST_SHARE = 0.2
"""Share of the frames expected at 10 Hz below which a window has no data worth a label."""

Stamps = Sequence[int]


class WizardError(Exception):
    """Why the recording cannot go on; the text names the remedy."""


class Source(Protocol):
    """The board being calibrated; every frame of it is recorded, asked for or not."""

    def tare(self) -> str:
        """Tare; what came of it. `WizardError` when it was refused."""

    def collect(self, seconds: float) -> Stamps:
        """Wait; the stamps, ns, of the frames that were captured meanwhile."""


Sink = Callable[[Stamps, float], None]
"""Takes the stamps of frames and the normal force on the skin while they were captured, N."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long is recorded of each part, s."""

    rest: float = 4.0
    hold: float = 2.0
    turn: float = 20.0


class Wizard:
    """Asks, waits and labels. ``ask`` returns what was typed, EOFError at the end of input."""

    def __init__(
        self,
        source: Source,
        sink: Sink,
        ask: Callable[[str], str],
        say: Callable[[str], None],
        timing: Timing,
    ) -> None:
        self._source, self._sink, self._timing = source, sink, timing
        self._ask, self._say = ask, say

    def run(self) -> int:
        """All steps; the number of presses, at least one, or `WizardError`."""
        self._say(
            "Lay the board down as it will be used. Have known weights at hand, or a force gauge. "
            "Press in several places and with several forces, the strongest you will meet included."
        )
        self._ask("Take everything off the skin, then Enter to tare: ")
        self._say(self._source.tare())
        self._label(0.0, self._timing.rest, "resting")
        presses = 0
        while (force := self._ask_force()) is not None:
            self._ask(f"Put {force:.3g} N on the skin, hold it steady, then Enter: ")
            self._label(force, self._timing.hold, "holding")
            self._ask("Take it off, then Enter: ")
            self._label(0.0, self._timing.rest, "resting")
            presses += 1
        if not presses:
            raise WizardError("no press was recorded; a calibration needs at least one")
        if self._yes(
            "Turn the untouched board every way, so that the earth's field is told from forces? "
            "[y/N] "
        ):
            self._ask("Enter to begin, then turn it slowly: ")
            self._label(0.0, self._timing.turn, "turning")
        return presses

    def _label(self, force: float, seconds: float, doing: str) -> None:
        self._say(f"  {doing}, {seconds:g} s ...")
        stamps = self._source.collect(seconds)
        if len(stamps) < max(1.0, LEAST_SHARE * 10 * seconds):
            raise WizardError(
                f"only {len(stamps)} frames came in {seconds:g} s; see whether tactiled still "
                "hears the board"
            )
        self._sink(stamps, force)

    def _ask_force(self) -> float | None:
        """Newtons of the next press; None when there is none."""
        while True:
            text = self._ask("Next press, in N or as a weight (3.2, 200g, 1kg); Enter to end: ")
            if not text.strip():
                return None
            force = parse_force(text)
            if force is not None:
                return force
            self._say(
                f"  {text.strip()!r} is no force; allowed: a number above 0 and up to "
                f"{MAX_FORCE_N:g} N, with N, g or kg after it"
            )

    def _yes(self, question: str) -> bool:
        return self._ask(question).strip().lower() in ("y", "yes")


def parse_force(text: str) -> float | None:
    """Newtons of what was typed; None when that is no force. Weights stand for their weight."""
    found = FORCE.fullmatch(text.strip())
    if found is None:
        return None
    force = float(found[1].replace(",", ".")) * NEWTON[found[2].lower()]
    return force if math.isfinite(force) and 0 < force <= MAX_FORCE_N else None
