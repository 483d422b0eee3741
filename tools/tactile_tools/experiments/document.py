"""Report as sections of text, tables and figures; written as one HTML file, PNGs and CSVs."""

from __future__ import annotations

import base64
import csv
import io
import math
import re
from dataclasses import dataclass, field
from pathlib import Path

from tactile_tools.experiments.rows import replace_file
from tactile_tools.experiments.spec import STRATEGIES
from tactile_tools.experiments.statistics import Rate


@dataclass(frozen=True, slots=True)
class TableData:
    """Table of text. ``name``: name of its CSV file; "" for none."""

    caption: str
    head: list[str]
    rows: list[list[str]]
    note: str = ""
    name: str = ""

    def to_csv(self) -> str:
        """Table as CSV."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.head)
        writer.writerows(self.rows)
        return out.getvalue()


@dataclass(frozen=True, slots=True)
class Picture:
    """Figure: its file's name without ending, its PNG, and a caption."""

    name: str
    png: bytes
    caption: str

    @property
    def data(self) -> str:
        """PNG in base64, for a page that needs no other file."""
        return base64.b64encode(self.png).decode()


@dataclass(frozen=True, slots=True)
class Section:
    """Part of the report, tables before figures."""

    title: str
    text: list[str] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    tables: list[TableData] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Document:
    """The report. ``lead``: introduction for a reader who does not know the subject."""

    title: str
    lead: list[str]
    sections: list[Section]
    facts: list[tuple[str, str]]

    def write(self, directory: Path) -> Path:
        """Write report.html, a PNG for each figure and a CSV for each named table; OSError."""
        from jinja2 import Environment, PackageLoader, StrictUndefined

        environment = Environment(
            loader=PackageLoader("tactile_tools.experiments", "."),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        environment.filters["set"] = typeset
        html = environment.get_template("report.html.j2").render(document=self)
        directory.mkdir(parents=True, exist_ok=True)
        for section in self.sections:
            for picture in section.pictures:
                replace_file(directory / f"{picture.name}.png", picture.png)
            for table in section.tables:
                if table.name:
                    replace_file(directory / f"{table.name}.csv", table.to_csv().encode())
        path = directory / "report.html"
        replace_file(path, html.encode())
        return path


def typeset(text: str) -> str:
    """``text`` with signs kept with their numbers by hard spaces, and minus signs for hyphens."""
    text = re.sub(r" (?=%)|(?<=\bp) (?=[=<] )|(?<=\bp [=<]) (?=\d)", "\u00a0", text)
    return re.sub(r"(?<![\w.–])-(?=\d)", "−", text)


def percent(rate: Rate) -> str:
    """Rate with its interval, such as "63 % [57, 68]"."""
    if not rate.trials:
        return "–"
    low, high = rate.interval
    return f"{whole(rate.value)} % [{whole(low)}, {whole(high)}]"


def whole(value: float) -> str:
    """Fraction in whole percent, halves rounded up as in print; "–" for NaN."""
    return "–" if math.isnan(value) else f"{math.floor(100 * value + 0.5)}"


def points(difference: float, interval: tuple[float, float]) -> str:
    """Difference of rates in percentage points with its interval."""
    # Adding 0 turns the −0 that rounding leaves into 0.
    shown, low, high = (round(100 * v) + 0 if v == v else v for v in (difference, *interval))
    return f"{shown:+.0f} [{low:+.0f}, {high:+.0f}]"


def shown_p(p: float) -> str:
    """A p-value for a table."""
    if math.isnan(p):
        return "–"
    if p < 1e-4:
        return "< 0.0001"
    return f"{p:.4f}" if p < 0.01 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def p_text(p: float) -> str:
    """A p-value for a sentence."""
    shown = shown_p(p)
    return f"p {shown}" if shown.startswith("<") else f"p = {shown}"


def slug(text: str) -> str:
    """``text`` as part of a file's name."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def in_words(name: str) -> str:
    """Name of a strategy in a sentence: the paper's in words, a user's own as given."""
    return name.replace("_", " ") if name in STRATEGIES else name


def listed(words: list[str]) -> str:
    """Words as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return ", ".join(words[:-1]) + " and " + words[-1]
