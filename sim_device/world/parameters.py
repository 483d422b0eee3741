"""The two named sets of physical parameters, with the reason for each value.

Sources: "paper" is Tables I and II and the text of *Tactile-Informed Action Primitives Mitigate
Jamming in Dense Clutter*; "simulator" is its authors' published PyBullet program, lengths divided
by ten. Forces are not divided: their lengths are ten times as great with gravity and mass as they
are, so that weight, friction and motor force keep their newtons, while moments have ten times the
lever. Where neither source gives a value it is ours, with the reason beside it.

| figure | hardware | authors_sim | disagreement and decision |
|---|---|---|---|
| v_max | 0.045 m/s, paper | 0.05 m/s, simulator | each keeps its own source's |
| ω_max | 0.1 rad/s, paper | 0.35 rad/s, simulator | likewise; 0.25 in excavation is a primitive's |
| F_max | 15 N, paper | 10 N per world axis, simulator | per world axis in both: the paper's |
| | | | bound on Fx and on Fy is that too |
| M_max | 4.5 N·m, paper | 1.5 N·m, simulator | 15 at a tenfold lever is 1.5 |
| time limit | 40 s, ours | 20 s, simulator | paper silent; within 20 s its own burrow |
| | | | cannot arrive (v_max × 20 s × 0.385 < the way) |
| success | 7.5 mm, paper | 1 mm, simulator | the outcomes give both |
| cupboard | 0.38 × 0.53 m, paper | 0.375 × 0.55 m, simulator | each its own |
| friction | as simulator | simulator | paper silent |
| inertia | × 1 | × 10 | lengths ten times as great with forces and times |
| | | | as they are: what moves there has ten times the |
| | | | momentum that its mass has here |
| finger | 4 kg, 0.45 kg·m², ours | 3 kg, 0.05 kg·m², ours | its 1.0 × 10 would not be at rest |
| | | | 0.1 s after the last command; its |
| | | | 0.237 ÷ 10 would chatter at 5 ms |
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from tactile_core.geometry import FINGER_OUTLINE
from tactile_core.types import ARM_LIMITS, ArmLimits

FINGER_WIDTH: Final = max(y for _, y in FINGER_OUTLINE) - min(y for _, y in FINGER_OUTLINE)
"""Width of the finger as built, m."""


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction coefficient of each pair of materials."""

    objects: float
    object_shelf: float
    object_wall: float
    finger_object: float
    finger_wall: float

    def __post_init__(self) -> None:
        """Check that engines can represent these; ValueError."""
        if not 0 < self.objects <= min(self.object_wall, self.finger_object):
            # Engines use the greater of two surfaces, so object on object is the lower limit.
            raise ValueError("object–object friction must be positive and the least of all")


@dataclass(frozen=True, slots=True)
class WorldParameters:
    """Physical parameters of one named set; SI.

    ``limits``: limits asked of the arm. ``finger_mass`` kg, ``finger_inertia`` kg·m² about the
    pivot: a velocity-controlled arm's apparent inertia, high enough that one physics step of full
    force changes the speed by less than half its limit. ``goal_radius`` m, ``time_limit`` s.
    ``inertia_scale``: factor from an object's mass by weight to its inertia; friction goes by
    weight. ``lip``: m, how far the shelf reaches out in front of the front edge. ``finger_width``:
    m, to which the finger's outline is stretched across.
    """

    name: str
    limits: ArmLimits
    time_limit: float
    goal_radius: float
    depth: float
    width: float
    lip: float
    friction: Friction
    finger_mass: float
    finger_inertia: float
    inertia_scale: float = 1.0
    finger_width: float = FINGER_WIDTH

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """Corners of the finger in ``ee``, m."""
        stretch = self.finger_width / FINGER_WIDTH
        return tuple((x, y * stretch) for x, y in FINGER_OUTLINE)


_SIMULATOR_FRICTION = Friction(
    # PyBullet multiplies: 0.4 an object, 0.85 the finger, 0.5 shelf and walls.
    objects=0.16,
    object_shelf=0.20,
    object_wall=0.20,
    finger_object=0.34,
    finger_wall=0.425,
)

WORLD_PARAMETERS: Final = MappingProxyType(
    {
        "hardware": WorldParameters(
            name="hardware",
            limits=ARM_LIMITS["hardware"],
            time_limit=40.0,
            goal_radius=0.0075,
            depth=0.38,
            width=0.53,
            lip=0.02,
            friction=_SIMULATOR_FRICTION,
            finger_mass=4.0,  # 15 N × 5 ms / 4 kg = 19 mm/s, below half of 45
            finger_inertia=0.45,  # 4.5 N·m × 5 ms / 0.45 kg·m² = 0.05 rad/s, half of 0.1
        ),
        "authors_sim": WorldParameters(
            name="authors_sim",
            limits=ARM_LIMITS["authors_sim"],
            time_limit=20.0,
            goal_radius=0.001,
            depth=0.375,
            width=0.55,
            lip=0.02,
            friction=_SIMULATOR_FRICTION,
            finger_mass=3.0,  # 10 N × 5 ms / 3 kg = 17 mm/s, below half of 50
            inertia_scale=10.0,
            finger_inertia=0.05,  # 1.5 N·m × 5 ms / 0.05 kg·m² = 0.15 rad/s, below half of 0.35
        ),
    }
)
"""The named sets; see the module's table."""


def world_parameters(name: str) -> WorldParameters:
    """Set called ``name``; ValueError lists the names."""
    try:
        return WORLD_PARAMETERS[name]
    except KeyError:
        known = ", ".join(sorted(WORLD_PARAMETERS))
        raise ValueError(f"no parameter set {name!r}; there are {known}") from None
