"""The learning curve of a training run as a picture."""

from __future__ import annotations

import json
from pathlib import Path

from matplotlib.figure import Figure


def draw(progress: Path, out: Path) -> None:
    """Draw the rows of ``progress``: who arrived in training and when judged, time, force."""
    rows = [json.loads(line) for line in progress.read_text(encoding="utf-8").splitlines()]
    trained = [row for row in rows if "arrived" in row and not row.get("early")]
    judged = [row for row in rows if "judged" in row]
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    share, seconds, force = figure.subplots(3, 1, sharex=True)
    count = max(1, len(trained) // 200)
    smooth = [trained[i : i + count] for i in range(0, len(trained), count)]
    share.plot(
        [part[-1]["decisions"] / 1e6 for part in smooth],
        [
            100 * sum(r["arrived"] * r["reaches"] for r in part)
            / max(1, sum(r["reaches"] for r in part))
            for part in smooth
        ],
        color="0.6",
        label="in training: varied, with noise in the motion",
    )  # fmt: skip
    at = [row["decisions"] / 1e6 for row in judged]
    share.plot(
        at,
        [100 * row["judged"]["arrived"] for row in judged],
        "o-",
        markersize=3,
        label="scenes it is judged by",
    )
    share.set_ylabel("arrived, %")
    seconds.plot(at, [row["judged"]["seconds"] for row in judged], "o-", markersize=3)
    seconds.set_ylabel("mean time, s")
    force.plot(
        at, [row["judged"]["force_p50"] for row in judged], "o-", markersize=3, label="median"
    )
    force.plot(at, [row["judged"]["force_p90"] for row in judged], "o-", markersize=3, label="90 %")
    force.set_ylabel("peak force, N")
    force.set_ylim(bottom=0)
    force.set_xlabel("decisions, millions")
    for axes in (share, seconds, force):
        axes.grid(alpha=0.3)
    for axes in (share, force):  # above the axes, off the data
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, borderpad=0.1)
    new = out.with_name(f".{out.name}")
    figure.savefig(new, dpi=120, format="png")
    new.replace(out)
