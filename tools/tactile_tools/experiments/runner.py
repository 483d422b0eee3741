"""Run the unfinished trials of a study, and write its tables."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sim_device.world.engines import make_world, world_maker
from sim_device.world.parameters import world_parameters
from sim_device.world.scenes import Pose, Scene
from sim_device.world.view import WorldView
from tactile_tools.experiments.backends import Backend
from tactile_tools.experiments.conditions import build_scene, parameters_of
from tactile_tools.experiments.journal import Journal, disk_error
from tactile_tools.experiments.rows import Row, replace_file, sort_rows, write_tables
from tactile_tools.experiments.spec import TrialSpec
from tactile_tools.experiments.studies import Study
from tactile_tools.experiments.trial import software_version

REFERENCE_CPU = 0.30
"""CPU-seconds that the authors' simulator needs per simulated second, without making the scene."""

WARM_UP = 100
"""Trials after which caches and the allocator's pools of a worker have filled."""

Progress = Callable[[int, int, Row | None], None]
"""Called with trials finished, trials in all, and the row that was just finished."""


class StudyError(ValueError):
    """A study cannot be run as it was asked for."""


def check(study: Study) -> None:
    """Check before the first trial what would make every trial fail; StudyError or ValueError."""
    if not study.specs:
        raise StudyError("the experiment has no trials: at least one scene and one strategy")
    import numpy as np

    from reachd.strategies import load_strategy

    seen: set[object] = set()
    for spec in study.specs:
        parts: tuple[tuple[object, Callable[[TrialSpec], object]], ...] = (
            (("parameters", spec.set, spec.parameters, spec.conditions), parameters_of),
            (
                ("strategy", spec.strategy, spec.set),
                lambda s: load_strategy(
                    s.strategy, s.resolved(), np.random.default_rng(0), lambda: _empty_view(s)
                ),
            ),
            (("depth", spec.depth), lambda s: s.typed_depth),
            (("source", spec.source), _check_source),
            (("engine", spec.engine), lambda s: world_maker(s.engine)),
        )
        for key, examine in parts:
            if key not in seen:
                seen.add(key)
                examine(spec)


def _empty_view(spec: TrialSpec) -> WorldView:
    """A world without objects for a privileged strategy that is only to be loaded."""
    start = Pose(-0.2, 0.0, 0.0)
    figures = world_parameters(spec.set)
    scene = Scene("empty", spec.set, 0, figures.depth, figures.width, start, (0.3, 0.0), ())
    return WorldView(make_world(spec.engine, scene))


def _check_source(spec: TrialSpec) -> None:
    """Check that the source exists. A scene that cannot be made is not an error: it gives a row."""
    try:
        build_scene(spec.source, spec.scene_seed, None)
    except RuntimeError:
        return


def run_study(
    study: Study,
    directory: Path,
    backend: Backend,
    progress: Progress,
    *,
    retry: bool = False,
) -> dict[str, Any]:
    """Run what is not finished in ``directory``, write tables and summary, return the summary.

    ``retry``: rerun trials that ended in an error. FolderError, DiskError, BackendError; what was
    finished by then is kept.
    """
    began = time.perf_counter()
    with Journal(directory, study.definition) as journal:
        finished = journal.load()
        if retry:
            finished = {spec: row for spec, row in finished.items() if row["error"] is None}
        rest = [spec for spec in study.specs if spec not in finished]
        before = len(study.specs) - len(rest)
        rows = {spec: finished[spec] for spec in study.specs if spec in finished}
        progress(before, len(study.specs), None)
        workers = 0
        if rest:
            with backend:
                workers = backend.workers
                for row in backend.run(rest):
                    journal.append(row)
                    rows[_key(row)] = row
                    progress(len(rows), len(study.specs), row)
        table = sort_rows(list(rows.values()))
        summary = summarize(table)
        summary["this_session"] = {
            "trials": len(rest),
            "workers": workers,
            "wall_s": round(time.perf_counter() - began, 2),
            "resumed": before,
            "damaged_lines": journal.damaged,
        }
        try:
            write_tables(table, directory)
            replace_file(
                directory / "summary.json", (json.dumps(summary, indent=1) + "\n").encode()
            )
        except OSError as error:
            raise disk_error(directory, error) from error
    return summary


def _key(row: Row) -> TrialSpec:
    from tactile_tools.experiments.spec import spec_of

    return spec_of(row)


def summarize(rows: Sequence[Row]) -> dict[str, Any]:
    """Cost of the rows: CPU, speed relative to the authors' simulator, memory of the workers."""
    good = [row for row in rows if row["error"] is None]
    cpu = sum(row["cpu_s"] for row in good)
    scenes = sum(row["scene_cpu_s"] for row in good)
    simulated = sum(row["simulated_s"] for row in good)
    return {
        "version": software_version(),
        "versions_of_rows": sorted({row["version"] for row in rows if row["version"]}),
        "trials": len(rows),
        "errors": len(rows) - len(good),
        "cpu_s": round(cpu, 2),
        "scene_cpu_s": round(scenes, 2),
        "simulated_s": round(simulated, 2),
        "trials_per_core_minute": round(60 * len(good) / (cpu + scenes), 2) if good else None,
        "cpu_s_per_simulated_s": round(cpu / simulated, 5) if simulated else None,
        "speedup_vs_reference": round(REFERENCE_CPU * simulated / cpu, 2) if cpu else None,
        "memory": memory_of(good),
    }


def memory_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Resident memory of the workers, MB: peak, and growth by a line fitted to each worker.

    ``growth_mb_per_1000``: the greatest of workers with enough trials after their first
    `WARM_UP`; None if there is no such worker.
    """
    import numpy as np

    courses: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        courses.setdefault(row["worker"], []).append((row["worker_trials"], row["memory_mb"]))
    slopes = []
    for course in courses.values():
        ordered = np.array(sorted(course))[WARM_UP:]
        if len(ordered) >= 2 * WARM_UP:
            slopes.append(1000 * float(np.polyfit(ordered[:, 0], ordered[:, 1], 1)[0]))
    return {
        "workers": len(courses),
        "peak_mb": max((row["memory_mb"] for row in rows), default=None),
        "growth_mb_per_1000": round(max(slopes), 2) if slopes else None,
    }
