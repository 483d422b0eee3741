"""``tactile bench``: every figure the project promises, measured side by side in one run."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

Figures = dict[str, float]


@dataclass(frozen=True, slots=True)
class Group:
    """Figures measured together by ``function`` of ``module``, which takes ``quick``."""

    name: str
    module: str
    function: str
    what: str


GROUPS = (
    Group("decode", "bench_wire", "bench_decode", "serial frames of 250 bytes"),
    Group("anyskin", "bench_wire", "bench_anyskin", "the AnySkin stream, beside its own host loop"),
    Group("pipeline", "bench_sensing", "bench_pipeline", "bytes to features, 4 arrays × 16 taxels"),
    Group("consensus", "bench_sensing", "bench_consensus", "consensus beside RANSAC"),
    Group("rotation", "bench_sensing", "bench_rotation", "a turn through 360° in a 50 µT field"),
    Group("latency", "bench_latency", "bench_latency", "pty to features in another process"),
    Group("soak", "bench_soak", "bench_soak", "memory over an hour of simulated frames"),
)


@dataclass(frozen=True, slots=True)
class Aim:
    """A bound on a figure: at most or at least ``bound``."""

    relation: str  # "≤" or "≥"
    bound: float

    def met(self, value: float) -> bool:
        """Whether ``value`` keeps the bound; NaN does not."""
        return value <= self.bound if self.relation == "≤" else value >= self.bound


AIMS: Mapping[str, Aim] = {
    "decode_fps": Aim("≥", 50_000),
    "anyskin_speedup": Aim("≥", 20),
    "pipeline_ms_p50": Aim("≤", 1.0),
    "pipeline_ms_p99": Aim("≤", 3.0),
    "consensus_speedup": Aim("≥", 100),
    "consensus_residual_ratio": Aim("≤", 1.0),
    "rotation_consensus_rms_n_25": Aim("≤", 0.05),
    "rotation_contact_bias_pct_25": Aim("≤", 5.0),
    "wire_to_feature_floor_ratio": Aim("≤", 2.0),
    "wire_to_feature_ms_p99": Aim("≤", 5.0),
}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench`` to the umbrella command."""
    parser = subparsers.add_parser(
        "bench",
        help="measure every promised figure",
        description="Measures every promised figure in one run. What is compared is measured side "
        "by side, because machines are shared and noisy. Groups: "
        + "; ".join(f"{g.name} ({g.what})" for g in GROUPS)
        + ".",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=[g.name for g in GROUPS],
        metavar="GROUP",
        help="measure these groups only",
    )
    parser.add_argument(
        "--quick", action="store_true", help="shorter runs (about a minute in all); rougher figures"
    )
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Measure and print; 0 when every group ran, whether or not its aims were met."""
    console = Console()
    chosen = [g for g in GROUPS if options.only is None or g.name in options.only]
    if options.json is not None and not options.json.resolve().parent.is_dir():
        print(
            f"tactile bench: --json {options.json}: there is no folder {options.json.parent}; "
            "create it or name another",
            file=sys.stderr,
        )
        return 2
    figures: Figures = {}
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        for number, group in enumerate(chosen, 1):
            task = progress.add_task(f"[{number}/{len(chosen)}] {group.name}: {group.what}")
            function: Callable[..., Figures] = getattr(
                import_module(f"tactile_tools.{group.module}"), group.function
            )
            try:
                figures |= function(quick=options.quick)
            except (RuntimeError, OSError) as error:
                print(f"tactile bench: {group.name}: {error}", file=sys.stderr)
                return 3
            progress.update(task, total=1, completed=1)
    console.print(table(figures))
    if options.json is not None:
        report = {
            "version": version("tactile-reach"),
            "machine": machine(),
            "quick": options.quick,
            "figures": figures,
            "aims": {
                key: {"relation": a.relation, "bound": a.bound, "met": a.met(figures[key])}
                for key, a in AIMS.items()
                if key in figures
            },
        }
        options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        console.print(f"wrote {options.json}")
    return 0


def machine() -> dict[str, object]:
    """Return what a reader needs to judge the figures by: processor, cores, load, Python."""
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    except OSError:
        pass  # not Linux: the generic name stands
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "system": platform.system(),
    }


def table(figures: Figures) -> Table:
    """Return figures beside their aims, as a table for a terminal."""
    shown = Table(title="tactile bench")
    for heading, justify in (("figure", "left"), ("measured", "right"), ("aim", "right")):
        shown.add_column(heading, justify="right" if justify == "right" else "left")
    shown.add_column("")
    for key, value in figures.items():
        aim = AIMS.get(key)
        verdict = "" if aim is None else "[green]met[/]" if aim.met(value) else "[red]missed[/]"
        bound = "" if aim is None else f"{aim.relation} {aim.bound:,g}"
        shown.add_row(key, f"{value:,.4g}" if abs(value) < 1e4 else f"{value:,.0f}", bound, verdict)
    return shown
