"""The paper's studies as lists of trials."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tactile_tools.experiments.axes import AXES, levels_of
from tactile_tools.experiments.journal import FolderError
from tactile_tools.experiments.spec import STRATEGIES, Conditions, TrialSpec, canonical

SWEEP_AMPLITUDES = tuple(round(0.45 + 0.05 * i, 2) for i in range(10))
SWEEP_FREQUENCIES = tuple(0.5 + 0.125 * i for i in range(10))
SWEEP_TIMES = tuple(1.875 + 0.625 * i for i in range(10))
"""The paper's Table II: A_bur; f_bur, in "Hz"; t_excv and t_trig, s."""

READINGS: Mapping[str, float] = {"rad": 1.0, "hz": 2.0 * math.pi}
"""Readings of the paper's f_bur: factor from its number to rad/s. The paper writes sin(f t) and
calls f a frequency in Hz; its authors' simulator takes it as rad/s in the sweep."""


@dataclass(frozen=True, slots=True)
class Options:
    """Options common to all studies.

    ``seed``: of the first scene; the others follow. ``source``: scenes, None for those of the
    set. ``parameters``: what differs from the set in every trial.
    """

    scenes: int
    seed: int
    sets: tuple[str, ...]
    engines: tuple[str, ...]
    depths: tuple[str, ...]
    source: str | None
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Study:
    """Experiment: its definition (plain JSON values), and its trials, scene by scene."""

    definition: dict[str, Any]
    specs: tuple[TrialSpec, ...]


@dataclass(frozen=True, slots=True)
class Cell:
    """Point of a sweep: primitive, reading of its frequency ("" for excavate), two values."""

    primitive: str
    reading: str
    row: int
    column: int
    parameters: Mapping[str, float]

    def of(self, base: Mapping[str, Any]) -> str:
        """Value of the column ``parameters`` for its trials, on top of ``base``."""
        return canonical({**base, **self.parameters})


def strategies_study(options: Options, strategies: tuple[str, ...] = STRATEGIES) -> Study:
    """Every strategy in every scene."""
    specs = [
        _with(base, strategy, options.parameters)
        for base in _bases(options)
        for strategy in strategies
    ]
    return _study("strategies", options, specs, strategies=strategies)


def sweep_study(options: Options, primitives: tuple[str, ...], readings: tuple[str, ...]) -> Study:
    """The paper's grids, and the straight line on the same scenes."""
    cells = sweep_cells(primitives, readings)
    specs = []
    for base in _bases(options):
        specs.append(_with(base, "straight", options.parameters))
        specs += [
            _with(base, cell.primitive, {**options.parameters, **cell.parameters}) for cell in cells
        ]
    return _study("sweep", options, specs, primitives=primitives, readings=readings)


def sweep_cells(primitives: Iterable[str], readings: Iterable[str]) -> list[Cell]:
    """Every cell. Burrow: rows are amplitudes, columns frequencies. Excavate: rows are excavation
    times, columns times between excavations.
    """
    cells = []
    if "burrow" in primitives:
        cells += [
            Cell(
                "burrow",
                reading,
                i,
                j,
                {"burrow_amplitude": a, "burrow_frequency": f * READINGS[reading]},
            )
            for reading in readings
            for i, a in enumerate(SWEEP_AMPLITUDES)
            for j, f in enumerate(SWEEP_FREQUENCIES)
        ]
    if "excavate" in primitives:
        cells += [
            Cell("excavate", "", i, j, {"excavate_duration": d, "trigger_interval": t})
            for i, d in enumerate(SWEEP_TIMES)
            for j, t in enumerate(SWEEP_TIMES)
        ]
    return cells


def robustness_study(
    options: Options, strategies: tuple[str, ...], axes: tuple[str, ...] = tuple(AXES)
) -> Study:
    """Every strategy at every level of every axis, one axis at a time."""
    specs = [
        _with(
            base,
            strategy,
            {**options.parameters, **level.parameters},
            level.conditions,
        )
        for base in _bases(options)
        for axis in axes
        for level in levels_of(axis, base.set)
        for strategy in strategies
    ]
    return _study("robustness", options, specs, strategies=strategies, axes=axes)


def _bases(options: Options) -> list[TrialSpec]:
    """A straight trial for each scene, set, engine and depth, scenes outermost."""
    return [
        TrialSpec(
            source=options.source or name,
            scene_seed=seed,
            set=name,
            engine=engine,
            depth=depth,
            strategy="straight",
            trial_seed=seed,
        )
        for seed in range(options.seed, options.seed + options.scenes)
        for name in options.sets
        for engine in options.engines
        for depth in options.depths
    ]


def _with(
    base: TrialSpec,
    strategy: str,
    parameters: Mapping[str, Any],
    conditions: Conditions | None = None,
) -> TrialSpec:
    return TrialSpec(
        source=base.source,
        scene_seed=base.scene_seed,
        set=base.set,
        engine=base.engine,
        depth=base.depth,
        strategy=strategy,
        trial_seed=base.trial_seed,
        parameters=canonical(parameters),
        conditions=(conditions or Conditions()).to_json(),
    )


def _study(name: str, options: Options, specs: Iterable[TrialSpec], **more: Any) -> Study:
    """Study with each trial once: several axes have the set's own values among their levels."""
    definition = {"study": name, **asdict(options), **{k: list(v) for k, v in more.items()}}
    for key in ("sets", "engines", "depths"):
        definition[key] = list(definition[key])
    return Study(definition, tuple(dict.fromkeys(specs)))


def rebuild(directory: Path, definition: Mapping[str, Any]) -> tuple[Study, Options]:
    """Study that ``definition`` describes, and its common options; FolderError."""
    try:
        options = Options(
            scenes=definition["scenes"],
            seed=definition["seed"],
            sets=tuple(definition["sets"]),
            engines=tuple(definition["engines"]),
            depths=tuple(definition["depths"]),
            source=definition["source"],
            parameters=definition["parameters"],
        )
        match definition["study"]:
            case "strategies":
                study = strategies_study(options, tuple(definition["strategies"]))
            case "sweep":
                readings = tuple(definition["readings"])
                study = sweep_study(options, tuple(definition["primitives"]), readings)
            case "robustness":
                axes = tuple(definition["axes"])
                study = robustness_study(options, tuple(definition["strategies"]), axes)
            case "benchmark":
                from tactile_tools.experiments.benchmark import benchmark_study

                limits = tuple(definition["limits"])
                study = benchmark_study(options, definition["strategies"][0], limits)
            case "oracle":
                from tactile_tools.experiments.benchmark import oracle_study

                study = oracle_study(options)
            case other:
                raise FolderError(f"{directory} is a study {other!r}, which this version lacks")
    except (KeyError, TypeError, ValueError) as error:
        raise FolderError(
            f"{directory}/experiment.json is damaged: {error!r}; run the experiment again elsewhere"
        ) from None
    return study, options
