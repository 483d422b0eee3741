"""``tactile benchmark``: one strategy on fixed scene sets, and what came out as an entry.

An entry is a JSON file with one row a case; a case is a scene set, an engine, a depth of sensing
and a time limit. `tactile_tools.dev.leaderboard` makes ``docs/leaderboard.md`` of entries.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median
from types import MappingProxyType
from typing import Any

from reachd.strategies.parameters import parameters
from sim_device.world.recorded_scenes import RECORDED
from sim_device.world.scene_loading import RECORDED_SCENES, find_recorded
from sim_device.world.scenes import SceneError
from tactile_tools.experiments.rows import Row, replace_file
from tactile_tools.experiments.spec import Conditions, TrialSpec, canonical, spec_of
from tactile_tools.experiments.statistics import Rate
from tactile_tools.experiments.studies import Options, Study

FORMAT = 1
"""Version of an entry's file."""

FIRST_SEED = 700_000
"""Of the scenes that are generated. Nobody tunes on scenes from here to `LAST_SEED`."""
LAST_SEED = 709_999

FIRST_RECORDED, LAST_RECORDED = 1, 60
"""Numbers of the scenes that were recorded in the authors' simulator."""

LIMITS_S = (20.0, 40.0)
"""Time limits, s: that of the authors' simulator, and that of the paper's bench."""


@dataclass(frozen=True, slots=True)
class SceneSet:
    """Scenes that differ in one thing. ``parameters``: name of the parameter set."""

    meaning: str
    source: str
    parameters: str
    conditions: Conditions = field(default_factory=Conditions)


SCENE_SETS: Mapping[str, SceneSet] = MappingProxyType(
    {
        "squeezed": SceneSet(
            "20 to 30 objects squeezed into 37.5 × 55 cm, as the authors' simulator makes them; "
            "the tip has to come within 1 mm",
            "authors_sim",
            "authors_sim",
        ),
        "dense": SceneSet(
            "the same with 30 to 34 objects",
            "authors_sim",
            "authors_sim",
            Conditions(objects=(30, 34)),
        ),
        "high_friction": SceneSet(
            "squeezed, with a friction of 0.45 between all surfaces",
            "authors_sim",
            "authors_sim",
            Conditions(friction_all=0.45),
        ),
        "narrow": SceneSet(
            "squeezed, with a finger of 7.5 cm instead of 5.7, for which every gap is narrow",
            "authors_sim",
            "authors_sim",
            Conditions(finger_width=0.075),
        ),
        "hardware": SceneSet(
            "15 to 22 objects on a grid, with the values of the paper's robot: slower, and the tip "
            "has to come within 7.5 mm",
            "hardware",
            "hardware",
        ),
        "recorded": SceneSet(
            "60 scenes that the authors' simulator made itself; not part of this repository",
            RECORDED,
            "authors_sim",
        ),
    }
)


def recorded_missing() -> str | None:
    """Why the recorded scenes cannot be used; None where they can."""
    try:
        find_recorded(RECORDED_SCENES)
    except SceneError as error:
        return str(error)
    return None


def benchmark_study(options: Options, strategy: str, limits_s: Sequence[float] = LIMITS_S) -> Study:
    """``strategy`` in every case; ``options.sets`` are names of `SCENE_SETS`.

    Case by case over the scenes, so that what was stopped early has some of each.
    """
    specs = [
        _spec(name, engine, depth, limit, _seed(name, index), strategy, options.parameters)
        for index in range(options.scenes)
        for name in options.sets
        if name != "recorded" or index <= LAST_RECORDED - FIRST_RECORDED
        for engine in options.engines
        for depth in options.depths
        for limit in limits_s
    ]
    definition = {
        "study": "benchmark",
        "scenes": options.scenes,
        "seed": options.seed,
        "sets": list(options.sets),
        "engines": list(options.engines),
        "depths": list(options.depths),
        "source": None,
        "parameters": dict(options.parameters),
        "strategies": [strategy],
        "limits": [float(limit) for limit in limits_s],
    }
    return Study(definition, tuple(dict.fromkeys(specs)))


def _seed(name: str, index: int) -> int:
    return index + (FIRST_RECORDED if name == "recorded" else FIRST_SEED)


def _spec(
    name: str,
    engine: str,
    depth: str,
    limit: float,
    seed: int,
    strategy: str,
    changed: Mapping[str, Any],
) -> TrialSpec:
    scenes = SCENE_SETS[name]
    own = parameters(scenes.parameters).time_limit
    timed = {} if limit == own else {"time_limit": limit}
    return TrialSpec(
        source=scenes.source,
        scene_seed=seed,
        set=scenes.parameters,
        engine=engine,
        depth=depth,
        strategy=strategy,
        trial_seed=seed,
        parameters=canonical({**changed, **timed}),
        conditions=scenes.conditions.to_json(),
    )


PRIVILEGED = "tactile_tools.oracle:PrivilegedPlanner"
"""The strategy that sees every object: the ceiling of a scene set."""


def oracle_study(options: Options) -> Study:
    """`PRIVILEGED` in scenes of each set (names of `SCENE_SETS`) and engine, in the set's time."""
    specs = [
        _oracle_spec(name, engine, seed, options.parameters)
        for seed in range(options.seed, options.seed + options.scenes)
        for name in options.sets
        for engine in options.engines
    ]
    definition = {
        "study": "oracle",
        "scenes": options.scenes,
        "seed": options.seed,
        "sets": list(options.sets),
        "engines": list(options.engines),
        "depths": ["contacts"],
        "source": None,
        "parameters": dict(options.parameters),
    }
    return Study(definition, tuple(dict.fromkeys(specs)))


def _oracle_spec(name: str, engine: str, seed: int, changed: Mapping[str, Any]) -> TrialSpec:
    limit = parameters(SCENE_SETS[name].parameters, changed).time_limit
    return _spec(name, engine, "contacts", limit, seed, PRIVILEGED, changed)


def oracle_summaries(study: Study, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """`summary_of` the rows that are there, for each set and engine of an oracle's study."""
    d = study.definition
    by_spec = {spec_of(row): row for row in rows}
    summaries = []
    for name in d["sets"]:
        for engine in d["engines"]:
            specs = [
                _oracle_spec(name, engine, seed, d["parameters"])
                for seed in range(d["seed"], d["seed"] + d["scenes"])
            ]
            if found := [by_spec[spec] for spec in specs if spec in by_spec]:
                limit = specs[0].resolved().time_limit
                case = {"set": name, "engine": engine, "depth": "contacts", "limit_s": limit}
                summaries.append(case | summary_of(found))
    return summaries


# Entries: what came out, by case.


class EntryError(ValueError):
    """A file that is not an entry: which, what is wrong, what to do."""


def entry_of(study: Study, rows: Sequence[Row], name: str, note: str) -> dict[str, Any]:
    """The entry ``name`` of the rows of ``study`` that are there: plain JSON values."""
    d = study.definition
    by_spec = {spec_of(row): row for row in rows}
    cases = []
    for scenes in d["sets"]:
        for engine in d["engines"]:
            for depth in d["depths"]:
                for limit in d["limits"]:
                    specs = [
                        _spec(
                            scenes,
                            engine,
                            depth,
                            limit,
                            _seed(scenes, index),
                            d["strategies"][0],
                            d["parameters"],
                        )
                        for index in range(_scenes_in(scenes, d["scenes"]))
                    ]
                    found = [by_spec[spec] for spec in specs if spec in by_spec]
                    if found:
                        case = {"set": scenes, "engine": engine, "depth": depth, "limit_s": limit}
                        cases.append(case | summary_of(found))
    return {
        "format": FORMAT,
        "name": name,
        "strategy": d["strategies"][0],
        "parameters": d["parameters"],
        "note": note,
        "versions": sorted({row["version"] for row in rows if row["version"]}),
        "commands": [command_of(d)],
        "cases": cases,
    }


def _scenes_in(name: str, asked: int) -> int:
    return min(asked, LAST_RECORDED - FIRST_RECORDED + 1) if name == "recorded" else asked


def command_of(definition: Mapping[str, Any]) -> str:
    """The command that repeats a benchmark."""
    words = ["tactile benchmark", *definition["strategies"]]
    words += ["--sets", *definition["sets"], "--engine", *definition["engines"]]
    words += ["--depth", *definition["depths"], "--time-limit"]
    words += [f"{limit:g}" for limit in definition["limits"]]
    words += ["--scenes", str(definition["scenes"])]
    for key, value in definition["parameters"].items():
        words += ["--param", f"{key}={json.dumps(value)}"]
    return " ".join(words)


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Success, time, forces, objects pushed out and cost of ``rows``; trials in error are counted.

    Rates are ``[count, trials, low, high]`` with Wilson's 95 % interval.
    """
    good = [row for row in rows if row["error"] is None]
    summary: dict[str, Any] = {
        "scenes": len(rows),
        "first_seed": min(row["scene_seed"] for row in rows),
        "errors": len(rows) - len(good),
    }
    if not good:
        return summary
    times = [row["time_s"] for row in good if row["success"]]
    simulated = sum(row["simulated_s"] for row in good)
    return summary | {
        "success": _rate([row["success"] for row in good]),
        "entered_7_5_mm": _rate([row["entered"] for row in good]),
        "time_s": {
            "mean": _rounded(fmean(row["time_s"] for row in good)),
            "median_of_reached": _rounded(median(times)) if times else None,
        },
        "peak_contact_n": _spread([row["peak_contact_n"] for row in good]),
        "peak_load_n": _spread([row["peak_load_n"] for row in good]),
        "mean_load_n": _rounded(fmean(row["mean_load_n"] for row in good)),
        "ejected_per_trial": _rounded(fmean(row["ejected"] for row in good)),
        "interventions_per_trial": _rounded(fmean(row["interventions"] for row in good)),
        "cpu_s_per_trial": _rounded(fmean(row["cpu_s"] for row in good)),
        "cpu_s_per_simulated_s": _rounded(sum(row["cpu_s"] for row in good) / simulated, 5)
        if simulated
        else None,
    }


def _rate(outcomes: Sequence[bool]) -> list[float]:
    rate = Rate(sum(outcomes), len(outcomes))
    low, high = rate.interval
    return [rate.count, rate.trials, _rounded(low), _rounded(high)]


def _spread(values: Sequence[float]) -> dict[str, float]:
    """Median and 90th percentile (the least value that 90 % do not exceed)."""
    ordered = sorted(values)
    p90 = ordered[max(0, math.ceil(0.9 * len(ordered)) - 1)]
    return {"median": _rounded(median(ordered), 2), "p90": _rounded(p90, 2)}


def _rounded(value: float, digits: int = 4) -> float:
    return round(float(value), digits)


def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """``old`` with the cases of ``new``, those that both have from ``new``; EntryError.

    An entry so grows by one command after another.
    """
    for key in ("name", "strategy", "parameters"):
        if old.get(key) != new[key]:
            raise EntryError(
                f"the entry there is of another {key} ({old.get(key)!r}, here {new[key]!r}): "
                "choose another --entry"
            )
    fresh = {_case_key(case) for case in new["cases"]}
    kept = [case for case in old["cases"] if _case_key(case) not in fresh]
    order = list(SCENE_SETS)
    cases = sorted(
        [*kept, *new["cases"]],
        key=lambda c: (order.index(c["set"]), c["engine"], c["depth"], c["limit_s"]),
    )
    return {
        **new,
        "note": new["note"] or old["note"],
        "versions": sorted({*old["versions"], *new["versions"]}),
        "commands": list(dict.fromkeys([*old["commands"], *new["commands"]])),
        "cases": cases,
    }


def _case_key(case: Mapping[str, Any]) -> tuple[object, ...]:
    return tuple(case[key] for key in ("set", "engine", "depth", "limit_s"))


def write_entry(entry: Mapping[str, Any], path: Path) -> None:
    """Write ``entry`` to ``path``, whole or not at all; OSError."""
    replace_file(path, (json.dumps(entry, indent=1, ensure_ascii=False) + "\n").encode())


def read_entry(path: Path) -> dict[str, Any]:
    """The entry in ``path``; EntryError."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise EntryError(f"cannot read {path}: {error}") from None
    wanted = {"name": str, "strategy": str, "note": str, "commands": list, "cases": list}
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise EntryError(
            f"{path} is not an entry in format {FORMAT}: make it with tactile benchmark"
        )
    for key, kind in wanted.items():
        if not isinstance(raw.get(key), kind):
            raise EntryError(f"{path}: {key!r} is missing: make the file with tactile benchmark")
    return raw
