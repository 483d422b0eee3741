"""Results of the paper and of its authors' simulator, for comparison with ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from tactile_tools.experiments.statistics import Rate


@dataclass(frozen=True, slots=True)
class Reference:
    """Results of others, by strategy; empty where they give none.

    ``label``: short name. ``what``: source. ``entered``: tip came within 7.5 mm.
    ``distance``, ``time``: means of d_goal/d_scene and of t_comp/t_tot.
    """

    label: str
    what: str
    success: Mapping[str, Rate]
    entered: Mapping[str, Rate] = field(default_factory=dict)
    distance: Mapping[str, float] = field(default_factory=dict)
    time: Mapping[str, float] = field(default_factory=dict)


def _rates(trials: int, **percent: int) -> Mapping[str, Rate]:
    """Rates from published percentages; the counts are rounded from them."""
    return MappingProxyType(
        {name: Rate(round(value * trials / 100), trials) for name, value in percent.items()}
    )


def _means(**values: float) -> Mapping[str, float]:
    return MappingProxyType(values)


PAPER_SIMULATION = Reference(
    "paper",
    "the paper's 300 simulated scenes",
    _rates(300, straight=22, burrow=67, excavate=56, hybrid_clock=68, hybrid_event=71),
)

PAPER_HARDWARE = Reference(
    "paper",
    "the paper's 25 scenes on hardware",
    _rates(25, straight=8, burrow=72, excavate=56, hybrid_clock=72, hybrid_event=84),
)

AUTHORS_SIMULATOR = Reference(
    "authors' simulator",
    "our runs of the authors' published simulator as it is, seeds 1 to 88",
    _rates(88, straight=33, burrow=59, excavate=40, hybrid_clock=51, hybrid_event=63),
    _rates(88, straight=33, burrow=63, excavate=42, hybrid_clock=60, hybrid_event=65),
    _means(straight=0.107, burrow=0.041, excavate=0.068, hybrid_clock=0.053, hybrid_event=0.037),
    _means(straight=0.83, burrow=0.81, excavate=0.86, hybrid_clock=0.92, hybrid_event=0.77),
)

REFERENCES: Mapping[str, tuple[Reference, ...]] = MappingProxyType(
    {
        "authors_sim": (PAPER_SIMULATION, AUTHORS_SIMULATOR),
        "hardware": (PAPER_HARDWARE,),
    }
)
"""References for the runs of each parameter set, if they use the set's own scenes."""

PAPER_EJECTED = MappingProxyType({"hybrid_clock": (5, 25), "hybrid_event": (1, 25)})
"""Objects pushed out of the front, and the number of trials on hardware."""


@dataclass(frozen=True, slots=True)
class SweepReference:
    """The paper's sweep: means of straight, the worst of all cells, and what to avoid by primitive
    and measure.
    """

    straight_distance: float
    straight_time: float
    straight_success: float
    worst_distance_ratio: float
    worst_time_ratio: float
    worst_success: Mapping[str, float]
    avoid: Mapping[tuple[str, str], str]


PAPER_SWEEP = SweepReference(
    straight_distance=0.098,
    straight_time=0.761,
    straight_success=0.38,
    worst_distance_ratio=1 / 3,  # "≈ 3-fold"
    worst_time_ratio=0.8,  # "≈ 20 %"
    worst_success=MappingProxyType({"burrow": 0.62, "excavate": 0.68}),
    avoid=MappingProxyType(
        {
            ("burrow", "distance"): "low A_bur with high f_bur",
            ("burrow", "time"): "high A_bur",
            ("excavate", "distance"): "high t_trig with high t_excv",
            ("excavate", "time"): "low t_trig with high t_excv",
        }
    ),
)
