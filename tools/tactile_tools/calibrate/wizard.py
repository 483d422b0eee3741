"""The questions of ``tactile calibrate record``, and the labels that follow from the answers.

Pure: it asks and talks through functions, gets frames from a `Source` and gives labels to a `Sink`.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from tactile_tools.calibrate.csv_pair import NEWTON_PER_GRAM_FORCE

MAX_FORCE_N = 1000.0
FORCE = re.compile(r"([0-9]*[.,]?[0-9]+)\s*(n|g|kg|)", re.IGNORECASE)
NEWTON = {"n": 1.0, "": 1.0, "g": NEWTON_PER_GRAM_FORCE, "kg": 1000 * NEWTON_PER_GRAM_FORCE}

PRESSES = 15
"""Presses that are asked for: six, one of each force, left an error of 40 % at a seventh."""

UNDO = ("u", "undo")
FORCE_IT = ("f", "force")

LEAST_FRAMES = 4
"""A window with fewer frames does not get a label."""

WIDTH = 80
"""Columns within which words are kept whole where a terminal does not say its width."""

Stamps = Sequence[int]


class WizardError(Exception):
    """The recording cannot go on; the text names the remedy."""


class TareRefusedError(WizardError):
    """The tare was refused; the text says why."""


class Source(Protocol):
    """The board being calibrated; every frame of it is recorded, asked for or not."""

    def tare(self, force: bool = False) -> str:
        """Tare; returns what came of it.

        `TareRefusedError` when it was refused, else `WizardError`.
        """

    def collect(self, seconds: float, least: int) -> Stamps:
        """Wait; returns the stamps, ns, of the frames that were captured meanwhile.

        It waits longer than ``seconds`` for ``least`` frames: a slow board sends few.
        """


Sink = Callable[[Stamps, float], None]
"""Takes the stamps of frames and the normal force on the skin while they were captured, N."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Length of each part of the recording, s."""

    rest: float = 4.0
    hold: float = 2.0
    turn: float = 20.0


class Wizard:
    """Asks, waits and labels. ``ask`` returns what was typed; EOFError at the end of input.

    ``width``: columns of the terminal, so that words are kept whole.
    """

    def __init__(
        self,
        source: Source,
        sink: Sink,
        ask: Callable[[str], str],
        say: Callable[[str], None],
        timing: Timing,
        width: int = WIDTH,
    ) -> None:
        self._source, self._sink, self._timing = source, sink, timing
        self._ask_whole, self._say_whole, self._width = ask, say, width
        self._last: list[tuple[Stamps, float]] = []
        """Labels of the last press, which may still be undone."""

    def run(self) -> int:
        """Take all steps; returns the number of presses, at least one, or raises `WizardError`."""
        self._say(
            "Lay the board down as it will be used. Have known weights at hand, or a force gauge. "
            f"{PRESSES} presses are asked for: in several places and with several forces, the "
            "strongest you will meet included. A press that went wrong can be undone."
        )
        self._ask("Take everything off the skin, then Enter to tare: ")
        self._tare()
        self._sink(self._record(self._timing.rest, "resting"), 0.0)
        presses = self._press_all()
        if not presses:
            raise WizardError("no press was recorded; a calibration needs at least one")
        self._keep()
        if self._yes(
            "Turn the untouched board every way, so that the earth's field is told from forces? "
            "[y/N] "
        ):
            self._ask("Enter to begin, then turn it slowly: ")
            self._sink(self._record(self._timing.turn, "turning"), 0.0)
        return presses

    def _tare(self) -> None:
        """Tare; if it is refused, try again or by force."""
        force = False
        while True:
            try:
                self._say(self._source.tare(force))
            except TareRefusedError as error:
                self._say(f"  {error}")
                answer = self._ask(
                    "Take everything off the skin and keep it still, then Enter to try again, or f "
                    "to tare as it is: "
                )
                force = answer.strip().lower() in FORCE_IT
            else:
                return

    def _press_all(self) -> int:
        """Record presses until the user ends them; returns how many are kept."""
        presses, warned = 0, False
        while True:
            force = self._ask_force(presses)
            if force is None and presses and presses < PRESSES and not warned:
                warned = True
                self._say(
                    f"  {presses} of {PRESSES} presses: after few, the force of another press may "
                    "be wrong by as much as 40 %. Enter again to end all the same."
                )
            elif force is None:
                return presses
            elif force == 0.0:
                presses -= self._undo()
            else:
                warned = False
                self._keep()
                presses += self._press(force)

    def _press(self, force: float) -> int:
        """Record one press and the rest after it, held back until the next press; returns 1."""
        self._ask(f"Put {force:.3g} N on the skin, hold it steady, then Enter: ")
        pressed = self._record(self._timing.hold, "holding")
        self._ask("Take it off, then Enter: ")
        self._last = [(pressed, force), (self._record(self._timing.rest, "resting"), 0.0)]
        return 1

    def _keep(self) -> None:
        """Hand over the labels of the last press."""
        for stamps, force in self._last:
            self._sink(stamps, force)
        self._last = []

    def _undo(self) -> int:
        """Forget the last press; returns how many were forgotten, 0 or 1."""
        if not self._last:
            self._say("  nothing to undo: only the last press can be, and only once")
            return 0
        self._say(f"  the press of {self._last[0][1]:.3g} N is undone")
        self._last = []
        return 1

    def _record(self, seconds: float, doing: str) -> Stamps:
        self._say(f"  {doing}, {seconds:g} s ...")
        stamps = self._source.collect(seconds, LEAST_FRAMES)
        if len(stamps) < LEAST_FRAMES:
            raise WizardError(
                f"only {len(stamps)} frames came in {seconds:g} s and some more; see whether "
                "tactiled still hears the board (tactile status)"
            )
        return stamps

    def _ask_force(self, presses: int) -> float | None:
        """Ask for the force of the next press, N; 0: undo the last press; None: the end."""
        count = f"{presses + 1} of {PRESSES}" if presses < PRESSES else f"{presses + 1}"
        undo = ", u to undo the last" if self._last else ""
        end = ", Enter to end" if presses else ""
        while True:
            text = self._ask(
                f"Next press ({count}), in N or as a weight (3.2, 200g, 1kg){undo}{end}: "
            ).strip()
            if not text:
                return None
            if text.lower() in UNDO:
                return 0.0
            force = parse_force(text)
            if force is not None:
                return force
            self._say(
                f"  {text[:WIDTH]!r} is not a force; allowed: a number above 0 and up to "
                f"{MAX_FORCE_N:g} N, with N, g or kg after it"
            )

    def _yes(self, question: str) -> bool:
        return self._ask(question).strip().lower() in ("y", "yes")

    def _ask(self, question: str) -> str:
        # The answer needs room after the question.
        return self._ask_whole(wrap(question, self._width - 8) + " ")

    def _say(self, text: str) -> None:
        self._say_whole(wrap(text, self._width))


def wrap(text: str, width: int) -> str:
    """Break ``text`` into lines of at most ``width`` columns, between words only.

    Further lines are indented like the first.
    """
    indent = text[: len(text) - len(text.lstrip())]
    return textwrap.fill(
        text.strip(),
        max(width, 20),
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def parse_force(text: str) -> float | None:
    """Force of what was typed, N; None when it is not a force. A mass stands for its weight."""
    found = FORCE.fullmatch(text.strip())
    if found is None:
        return None
    force = float(found[1].replace(",", ".")) * NEWTON[found[2].lower()]
    return force if math.isfinite(force) and 0 < force <= MAX_FORCE_N else None
