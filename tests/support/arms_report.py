"""What the conformance tests of arms measured: collected in a file, and shown in docs/arm.md.

``ARMS_JSON=docs/results/arms.json``: the tests add to that file as they run. ``python -m
tests.support.arms_report`` writes its tables into docs/arm.md, between two comments.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "docs" / "results" / "arms.json"
PAGE = ROOT / "docs" / "arm.md"
BEGIN, END = "<!-- from results/arms.json -->", "<!-- end -->"
DRIVERS = ("simulated", "mock", "ur", "xarm", "flexiv", "franka")

Report = dict[str, Any]


def note(driver: str, fault: str, rest: Any = None) -> None:
    """``driver`` has stood ``fault`` once; ``rest``: seconds and metres from it to rest."""

    def add(report: Report) -> None:
        row = report["faults"].setdefault(fault, {}).setdefault(driver, {"runs": 0})
        row["runs"] += 1
        if rest is not None:
            row["rest_s"] = max(row.get("rest_s", 0.0), round(rest.seconds, 3))
            row["mm"] = max(row.get("mm", 0.0), round(rest.metres * 1e3, 2))

    _change(add)


def note_latencies(driver: str, status: Report) -> None:
    """Keep what the arm's `status` says of its latencies."""
    kept = {name: status[name] for name in ("decided_to_wire_ms", "state_to_bus_ms")
            if status.get(name)}  # fmt: skip
    kept |= {"load": round(os.getloadavg()[0], 1)}

    def add(report: Report) -> None:
        if _count(kept) > _count(report["latencies"].get(driver, {})):
            report["latencies"][driver] = kept

    _change(add)


def _count(latencies: Report) -> int:
    return int(latencies.get("decided_to_wire_ms", {}).get("n", 0))


def note_skipped(driver: str, reason: str) -> None:
    """``driver`` could not be tried here."""
    _change(lambda report: report["skipped"].update({driver: reason}))


def _change(change: Any) -> None:
    name = os.environ.get("ARMS_JSON")
    if not name:
        return
    path = Path(name)
    report: Report = {"faults": {}, "latencies": {}, "skipped": {}}
    if path.exists():
        report = json.loads(path.read_text(encoding="utf-8"))
    change(report)
    path.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def tables(report: Report) -> str:
    """Faults × drivers, and latencies, in Markdown."""
    faults = report["faults"]
    drivers = [d for d in DRIVERS if any(d in rows for rows in faults.values())]
    lines = ["| fault in motion | " + " | ".join(f"`{d}`" for d in drivers) + " |"]
    lines.append("|---" * (len(drivers) + 1) + "|")
    for fault, rows in faults.items():
        lines.append(f"| {fault} | " + " | ".join(_cell(rows.get(d)) for d in drivers) + " |")
    lines += ["", "| p50 / p99, ms | " + " | ".join(f"`{d}`" for d in drivers) + " |"]
    lines.append("|---" * (len(drivers) + 1) + "|")
    for name, words in (
        ("decided_to_wire_ms", "decided → on the wire"), ("state_to_bus_ms", "state → bus"),
    ):  # fmt: skip
        found = [report["latencies"].get(d, {}).get(name) for d in drivers]
        cells = [f"{f['p50']:.1f} / {f['p99']:.1f}" if f else "" for f in found]
        lines.append(f"| {words} | " + " | ".join(cells) + " |")
    lines += [f"\n`{d}` was not tried: {why}." for d, why in report["skipped"].items()]
    return "\n".join(lines)


def _cell(row: Report | None) -> str:
    if row is None:
        return "–"
    times = f" ({row['runs']} ×)"
    if "mm" not in row:
        return "stood" + times
    return f"{row['mm']:.1f} mm, {row['rest_s'] * 1e3:.0f} ms" + times


def page_with(text: str, report: Report) -> str:
    """``text`` of the page with the tables of ``report``."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{tables(report)}\n\n{END}{after}"


def main() -> int:
    """Write the tables into the page."""
    report = json.loads(RESULT.read_text(encoding="utf-8"))
    PAGE.write_text(page_with(PAGE.read_text(encoding="utf-8"), report), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
