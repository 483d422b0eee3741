"""``tactile experiment report``: a run as one HTML page, its figures and its tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tactile_tools.experiments.document import Document, Section, TableData
from tactile_tools.experiments.report_robustness import robustness_sections
from tactile_tools.experiments.report_strategies import strategy_sections
from tactile_tools.experiments.report_sweep import sweep_sections
from tactile_tools.experiments.rows import TableError
from tactile_tools.experiments.runner import summarize
from tactile_tools.experiments.tables import Run, archive, load_run

PAPER = (
    "A robot arm with a finger reaches into a cluttered cupboard toward a place it cannot see. "
    "Objects jam in front of the finger, and pushing harder does not help. The paper “Tactile-"
    "Informed Action Primitives Mitigate Jamming in Dense Clutter” (Brouwer et al., ICRA 2024) "
    "proposes two motions that free a jam: burrow, which wiggles sideways on the way, and "
    "excavate, in which the tip traces a growing arc that clears room. It compares five "
    "strategies: straight ahead; burrow all the way; straight with an excavation from time to "
    "time; burrow with excavations by the clock (hybrid clock); and a strategy that goes straight "
    "when it feels nothing, burrows when it feels resistance, and excavates when touch says that "
    "it is stuck (hybrid event)."
)

MEASURES = (
    "Success is reaching the goal within the time limit. Normalised distance is how far the tip "
    "is from the goal at the end, over the depth of the cupboard; normalised time is the time "
    "taken over the time limit, 1 where the goal was not reached. Less is better for both. A "
    "difference is called significant, or beyond chance, where one as large would come up by "
    "chance in fewer than one of twenty repeats (p < 0.05)."
)

TITLES = {
    "strategies": "Five strategies in the same scenes",
    "sweep": "The primitives' parameters, swept",
    "robustness": "What the strategies withstand",
}


def write_report(run_directory: Path, out: Path, *, rows: bool = False) -> Path:
    """Write the report of the run into ``out`` and return its path. FolderError, TableError,
    OSError.

    ``rows``: also put the run's table there, from which any row can be rerun and the report made
    again.
    """
    run = load_run(run_directory)
    document = build(run)
    if rows and out.resolve() != run_directory.resolve():
        archive(run, out)
    return document.write(out)


def build(run: Run) -> Document:
    """Report of ``run``; TableError if it has no rows yet."""
    if not any(row["error"] is None for row in run.rows):
        raise TableError(
            f"{run.directory} has no finished trials"
            + (": every one of them failed, see its trials.csv" if run.rows else "")
        )
    makers: dict[str, Callable[[Run], list[Section]]] = {
        "strategies": strategy_sections,
        "sweep": sweep_sections,
        "robustness": robustness_sections,
    }
    if run.kind not in makers:
        raise TableError(
            f"{run.directory} is a run of the study {run.kind!r}, which has no report: its command "
            "prints what came out; given again, it runs nothing that is finished"
        )
    sections = makers[run.kind](run)
    if failures := _failures(run):
        sections.append(failures)
    lead = [PAPER, MEASURES]
    if run.missing:
        lead.insert(
            0,
            f"This run is not finished: {run.missing} of its {len(run.study.specs)} trials are "
            "missing, and everything below is of those that are there.",
        )
    return Document(TITLES[run.kind], lead, sections, _facts(run))


def _failures(run: Run) -> Section | None:
    """Trials that could not be run, by reason; None if there are none."""
    errors = Counter(row["error"] for row in run.rows if row["error"] is not None)
    if not errors:
        return None
    return Section(
        "Trials that could not be run",
        text=[
            f"{errors.total()} of {len(run.rows)} trials ended before they began or could not be "
            "finished. They are not counted above unless it says so there."
        ],
        tables=[
            TableData(
                "Reasons",
                ["reason", "trials"],
                [[text[:160], str(count)] for text, count in errors.most_common(10)],
            )
        ],
    )


def _facts(run: Run) -> list[tuple[str, str]]:
    """Origin and cost of the figures."""
    summary = summarize(run.rows)
    options = run.options
    memory = summary["memory"]
    growth = memory["growth_mb_per_1000"]
    return [
        ("trials", f"{len(run.rows)} of {len(run.study.specs)}"),
        (
            "scenes",
            f"{options.scenes}, seeds {options.seed} to {options.seed + options.scenes - 1}",
        ),
        ("parameter sets", ", ".join(options.sets)),
        ("engines", ", ".join(options.engines)),
        ("sensing", ", ".join(options.depths)),
        (
            "parameters changed",
            ", ".join(f"{k} = {v}" for k, v in options.parameters.items()) or "none",
        ),
        ("software", ", ".join(summary["versions_of_rows"])),
        ("CPU time", f"{(summary['cpu_s'] + summary['scene_cpu_s']) / 60:.1f} min"),
        ("trials per core and minute", f"{summary['trials_per_core_minute']}"),
        (
            "speed",
            f"{summary['cpu_s_per_simulated_s']} CPU-s a simulated second, "
            f"{summary['speedup_vs_reference']} × the authors' simulator",
        ),
        (
            "memory of a worker",
            f"{memory['peak_mb']:.0f} MB at most"
            + ("" if growth is None else f", {growth:+.1f} MB in 1,000 trials"),
        ),
    ]
