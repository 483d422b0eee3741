"""``tactile bench``: measure every promised figure, side by side in one run."""

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
from typing import Any

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from tactile_core.cli import CommandError

Figures = dict[str, float]


@dataclass(frozen=True, slots=True)
class Group:
    """Figures measured together by ``function`` of ``module``, which takes ``quick``.

    ``promised``: those of its figures that have an aim. ``asked``: measured only when named.
    """

    name: str
    module: str
    function: str
    what: str
    promised: tuple[str, ...] = ()
    asked: bool = False


GROUPS = (
    Group("decode", "wire", "bench_decode", "serial frames of 250 bytes", ("decode_fps",)),
    Group(
        "anyskin",
        "wire",
        "bench_anyskin",
        "the AnySkin stream, beside its own host loop",
        ("anyskin_speedup",),
    ),
    Group(
        "pipeline",
        "sensing",
        "bench_pipeline",
        "bytes to features, 4 arrays × 16 taxels",
        ("pipeline_ms_p50", "pipeline_ms_p99"),
    ),
    Group(
        "consensus",
        "sensing",
        "bench_consensus",
        "consensus beside RANSAC",
        ("consensus_speedup", "consensus_residual_ratio"),
    ),
    Group(
        "rotation",
        "sensing",
        "bench_rotation",
        "a turn through 360° in a 50 µT field",
        ("rotation_consensus_rms_n_25", "rotation_contact_bias_pct_25"),
    ),
    Group(
        "skin5",
        "skin5",
        "bench_skin5",
        "presses and turns of a board of five magnetometers",
        ("skin5_force_error", "skin5_rest_n", "skin5_bound_coverage", "skin5_bound_median_n"),
    ),
    Group(
        "calibration",
        "calibration",
        "bench_calibration",
        "a fitted model, per board and frame",
        (
            "calibration_anyskin_ms_p50",
            "calibration_finger_ms_p50",
            "calibration_place_ms_p50",
        ),
    ),
    Group(
        "latency",
        "latency",
        "bench_latency",
        "pty to features in another process",
        ("wire_to_feature_floor_ratio", "wire_to_feature_ms_p99"),
    ),
    Group(
        "reach",
        "reach",
        "bench_reach_speed",
        "reaches in lockstep among 25 objects",
        ("reach_rtf_contacts", "reach_rtf_taxels"),
    ),
    Group(
        "worlds",
        "worlds",
        "bench_worlds",
        "reaches in the planar engine, and 256 cupboards at once, only when named",
        ("planar_rtf_contacts", "planar_rtf_taxels", "worlds_rtf"),
        asked=True,
    ),
    Group(
        "reference",
        "reach",
        "bench_reference",
        "the same trials in the authors' engine, only when named",
        ("speedup_vs_reference_engine",),
        asked=True,
    ),
    Group(
        "live",
        "reach",
        "bench_reach_live",
        "punctuality of a reach in three processes",
        ("loop_late_ms_p99", "loop_late_ms_p99.9", "wire_to_twist_ms_p99"),
    ),
    Group(
        "stop",
        "stop",
        "bench_stop",
        "standing still after SIGSTOP and SIGKILL of each process",
        ("stop_ms_max_features", "stop_ms_max_arm_state", "stop_ms_max_commands"),
    ),
    Group("cpu", "cpu", "bench_cpu", "processor time of tactiled with one and four fingers"),
    Group(
        "contact_force",
        "contact",
        "bench_contact_force",
        "force of a hundred reaches in lockstep, only when named",
        ("contact_peak_n_max", "contact_above_limit_ms_max"),
        asked=True,
    ),
    Group(
        "view",
        "view",
        "bench_view",
        "the live page beside the raw bus",
        ("view_latency_ms_p50", "view_cpu_pct"),
    ),
    Group(
        "client",
        "view",
        "bench_client",
        "a message through the client beside the codec alone",
        ("client_overhead_us",),
    ),
    Group("soak", "soak", "bench_soak", "memory over an hour of simulated frames"),
    Group(
        "stress",
        "stress",
        "bench_stress",
        "an hour of reaching on a loaded machine, only when named",
        ("stress_late_ms_p99.9", "stress_late_moving"),
        asked=True,
    ),
)


@dataclass(frozen=True, slots=True)
class Aim:
    """Bound on a figure: at most or at least ``bound``."""

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
    "skin5_force_error": Aim("≤", 1.0),
    "skin5_rest_n": Aim("≤", 0.05),
    "skin5_bound_coverage": Aim("≥", 0.99),
    "skin5_bound_median_n": Aim("≤", 0.4),
    "calibration_anyskin_ms_p50": Aim("≤", 0.3),
    "calibration_finger_ms_p50": Aim("≤", 0.3),
    "calibration_place_ms_p50": Aim("≤", 0.3),
    "wire_to_feature_floor_ratio": Aim("≤", 2.0),
    "wire_to_feature_ms_p99": Aim("≤", 5.0),
    "reach_rtf_contacts": Aim("≥", 80),
    "reach_rtf_taxels": Aim("≥", 30),
    "planar_rtf_contacts": Aim("≥", 150),
    "planar_rtf_taxels": Aim("≥", 40),
    "worlds_rtf": Aim("≥", 300),
    "speedup_vs_reference_engine": Aim("≥", 25),
    "loop_late_ms_p99": Aim("≤", 5.0),
    "loop_late_ms_p99.9": Aim("≤", 10.0),
    "wire_to_twist_ms_p99": Aim("≤", 20.0),  # 10 ms and the loop's period
    "stop_ms_max_features": Aim("≤", 200.0),
    "stop_ms_max_arm_state": Aim("≤", 50.0),
    "stop_ms_max_commands": Aim("≤", 100.0),
    "view_latency_ms_p50": Aim("≤", 50.0),
    "view_cpu_pct": Aim("≤", 5.0),
    "client_overhead_us": Aim("≤", 100.0),
    "contact_peak_n_max": Aim("≤", 18.0),
    "contact_above_limit_ms_max": Aim("≤", 20.0),
    "stress_late_ms_p99.9": Aim("≤", 5.0),
    "stress_late_moving": Aim("≤", 0.0),
}


def _group_of(name: str) -> str:
    """Name of the group that has this name or a figure of this name; CommandError."""
    for group in GROUPS:
        if name in (group.name, *group.promised):
            return group.name
    groups = ", ".join(g.name for g in GROUPS)
    raise CommandError(
        f"{name!r} is not a group or a figure; groups: {groups}; figures: {', '.join(AIMS)}"
    )


def run(options: argparse.Namespace) -> int:
    """Measure and print. Returns 0 if every group ran, whether or not its aims were met."""
    console = Console()
    only = None if not options.only else [_group_of(name) for name in options.only]
    chosen = [g for g in GROUPS if (not g.asked if only is None else g.name in only)]
    if options.out is not None and not options.out.resolve().parent.is_dir():
        print(
            f"tactile bench: --out {options.out}: there is no folder {options.out.parent}; "
            "create it or name another",
            file=sys.stderr,
        )
        return 2
    try:
        kept = {} if only is None else _previous_report(options.out)
    except ValueError as error:
        print(f"tactile bench: --out {options.out}: {error}", file=sys.stderr)
        return 2
    figures: Figures = {}
    loads: dict[str, object] = {}
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        for number, group in enumerate(chosen, 1):
            task = progress.add_task(f"[{number}/{len(chosen)}] {group.name}: {group.what}")
            function: Callable[..., Figures] = getattr(
                import_module(f"tactile_tools.dev.benches.{group.module}"), group.function
            )
            before = os.getloadavg()[0]
            try:
                figures |= function(quick=options.quick)
            except (RuntimeError, OSError) as error:
                print(f"tactile bench: {group.name}: {error}", file=sys.stderr)
                return 3
            loads[group.name] = {
                "load_before": round(before, 2),
                "load_after": round(os.getloadavg()[0], 2),
                "quick": options.quick,
            }
            progress.update(task, total=1, completed=1)
    console.print(table(figures))
    console.print(f"load average (1 min) while measuring: {_range_of_loads(loads)}")
    if options.out is not None:
        all_figures = kept.get("figures", {}) | figures
        report = {
            "version": version("tactile-reach"),
            "machine": machine(),
            "quick": options.quick,
            "figures": all_figures,
            "aims": {
                key: {"relation": a.relation, "bound": a.bound, "met": a.met(all_figures[key])}
                for key, a in AIMS.items()
                if key in all_figures
            },
            "groups": kept.get("groups", {}) | loads,
        }
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        console.print(f"wrote {options.out}")
    return 0


def _previous_report(path: Path | None) -> dict[str, Any]:
    """Report in ``path``; empty if there is none. ValueError."""
    if path is None or not path.exists():
        return {}
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read, so cannot be added to: {error}") from error
    if not isinstance(report, dict) or not isinstance(report.get("figures"), dict):
        raise ValueError("is not a report of this command: name another file")
    return report


def _range_of_loads(loads: Mapping[str, Any]) -> str:
    values = [v for group in loads.values() for v in (group["load_before"], group["load_after"])]
    return f"{min(values):.2f} to {max(values):.2f}" if values else "none"


def machine() -> dict[str, object]:
    """Processor, cores, load and Python, which a reader needs to judge the figures."""
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
    """Figures beside their aims, as a table for a terminal."""
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
