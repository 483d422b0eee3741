"""Typed values of the messages on the bus.

Units: s, ns, m, rad, N, N m, µT. Frame ``ee``: origin at the wrist pivot, x along the finger
towards its tip, y to the left, z up. Frame ``cupboard``: x into the cupboard, y to the left. Forces
are those that the environment exerts on the skin or the end-effector. Arrays are read-only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tactile_core.geometry import Side

Floats = NDArray[np.float32]

SideName = Literal["none", "left", "right", "tip"]

SIDES: dict[int, SideName] = {0: "none", 1: "left", 2: "right", 3: "tip"}
"""Names of the sides by their number in messages; see `tactile_core.geometry.Side`."""

assert {int(side): side.name.lower() for side in Side} == SIDES


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One cluster of neighbouring taxels in contact.

    ``force``: (3,) N in ``ee``. ``centroid``: (3,) m in ``ee``, weighted by normal force.
    ``normal``: unit vector out of the skin in ``ee``. ``normal_force_bound``: N; in 95 % of cycles
    the true normal force is within this. Both are NaN in logs of versions that did not have them.
    """

    array: int
    side: SideName
    taxels: int
    normal_force: float
    peak_force: float
    force: tuple[float, float, float]
    centroid: tuple[float, float, float]
    normal: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    normal_force_bound: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Contact features of a board, once per cycle.

    If ``valid`` is False, do not act on them; ``reasons`` say why and what to do, and
    ``reason_codes`` are the same as stable words. ``normal_force``: N, sum over the skin.
    ``..._bound``: N; in 95 % of cycles the true value is within this. ``wrench``: force (N) and
    moment (N m) about the origin of ``ee``. ``captured_ns``: monotonic clock of tactiled's machine;
    ``wall_ns``: Unix time.
    """

    sequence: int
    captured_ns: int
    wall_ns: int
    valid: bool
    reasons: tuple[str, ...]
    reason_codes: tuple[str, ...]
    calibrated: bool
    normal_force: float
    normal_force_bound: float
    peak_force: float
    peak_force_bound: float
    peak_side: SideName
    peak_position: tuple[float, float, float]
    tip_force: float
    tip_force_bound: float
    tip_contact_time: float
    wrench: tuple[float, float, float, float, float, float]
    taxels_in_contact: int
    taxels_masked: int
    patches: tuple[Patch, ...]

    @property
    def shear_force(self) -> float:
        """Shear force in N: sum over the patches of the length of the tangential part of their
        force.

        Exact for contacts on flat arrays; an estimate if a contact bends around an edge.
        """
        total = 0.0
        for patch in self.patches:
            square = sum(part * part for part in patch.force) - patch.normal_force**2
            total += math.sqrt(max(square, 0.0))
        return total


@dataclass(frozen=True, slots=True, eq=False)
class Forces:
    """Forces on every taxel in one cycle of a board.

    ``force``: (n, 3) N in each taxel's axes, z outward: a press is negative. ``normal``: (n,) N,
    positive for a press. ``bound``: (n,) N, NaN where masked. ``status``: (n,) bits, 0 for a
    healthy taxel. ``array_taxels``: number of taxels of each array, in the order of the arrays.
    """

    sequence: int
    captured_ns: int
    wall_ns: int
    force: Floats
    bound: Floats
    status: NDArray[np.uint8]
    array_taxels: tuple[int, ...]
    compensated: bool
    calibrated: bool

    @property
    def normal(self) -> Floats:
        """(n,) N, positive for a press."""
        return -self.force[:, 2]

    @property
    def shear(self) -> Floats:
        """(n, 2) N along x and y of each taxel."""
        return self.force[:, :2]


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Field at every taxel before compensation. ``field_ut``: (n, 3) µT in each taxel's axes.

    ``temperature_c``: °C, one per array (or per taxel if the board reports them).
    """

    sequence: int
    captured_ns: int
    wall_ns: int
    field_ut: Floats
    temperature_c: Floats
    array_taxels: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Ambient:
    """Ambient field removed by compensation: ``field_ut`` (arrays, 3) µT at each array's centre.

    ``support``: fraction of an array's healthy taxels that agree. ``residual_ut``: rms about the
    fit.
    """

    sequence: int
    captured_ns: int
    wall_ns: int
    method: str
    field_ut: Floats
    support: Floats
    residual_ut: Floats
    age_s: Floats
    valid: tuple[bool, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ArrayLayout:
    """One array of a skin. ``taxels``: its slice within data of the whole board."""

    name: str
    side: SideName
    rows: int
    columns: int
    posed: bool
    taxels: slice


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """Places of the taxels.

    ``position``, ``normal``: (n, 3) m and unit vectors in ``ee``. ``surface``: (n, 2) m on the
    unrolled skin; empty for boards of more than 2,000 taxels.
    """

    model: str
    serial_number: str
    frame: str
    arrays: tuple[ArrayLayout, ...]
    position: Floats
    normal: Floats
    surface: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """State reported by an arm: pose of its wrist pivot in ``cupboard`` (m, rad), twist, wrench.

    ``twist``: m/s, m/s, rad/s. ``wrench``: N, N, N m about the pivot.
    """

    sequence: int
    captured_ns: int
    wall_ns: int
    x: float
    y: float
    heading: float
    twist: tuple[float, float, float]
    wrench: tuple[float, float, float]
    mode: str
    commander: str


@dataclass(frozen=True, slots=True, eq=False)
class ReachState:
    """State of reachd. ``distance``: m from tip to goal, NaN without a goal.

    ``wanted``, ``commanded``: m/s, m/s, rad/s before and after the safety gate.
    """

    sequence: int
    wall_ns: int
    state: str
    activity: str
    strategy: str
    goal: tuple[float, float]
    goal_radius: float
    distance: float
    elapsed: float
    wanted: tuple[float, float, float]
    commanded: tuple[float, float, float]
    armed: bool
    held: str
    interventions: tuple[str, ...]


def _wall_ns(header: Any) -> int:
    stamp = header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _triple(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _planar(twist: Any) -> tuple[float, float, float]:
    return twist.linear.x, twist.linear.y, twist.angular.z


def _patch(message: Any) -> Patch:
    told = hasattr(message, "normal")
    return Patch(
        message.array,
        SIDES.get(message.side, "none"),
        message.taxels,
        message.normal_force,
        message.peak_force,
        _triple(message.force),
        _triple(message.centroid),
        _triple(message.normal) if told else (math.nan, math.nan, math.nan),
        message.normal_force_bound if told else math.nan,
    )


def features(message: Any) -> Features:
    """Convert a ``ContactFeatures`` message."""
    m = message
    return Features(
        sequence=m.sequence,
        captured_ns=m.captured_ns,
        wall_ns=_wall_ns(m.header),
        valid=m.valid,
        reasons=tuple(m.reasons),
        reason_codes=tuple(m.reason_codes),
        calibrated=m.calibrated,
        normal_force=m.normal_force,
        normal_force_bound=m.normal_force_bound,
        peak_force=m.peak_force,
        peak_force_bound=m.peak_force_bound,
        peak_side=SIDES.get(m.peak_side, "none"),
        peak_position=_triple(m.peak_position),
        tip_force=m.tip_force,
        tip_force_bound=m.tip_force_bound,
        tip_contact_time=m.tip_contact_time,
        wrench=(*_triple(m.wrench.force), *_triple(m.wrench.torque)),
        taxels_in_contact=m.taxels_in_contact,
        taxels_masked=m.taxels_masked,
        patches=tuple(_patch(patch) for patch in m.patches),
    )


def forces(message: Any) -> Forces:
    """Convert a ``TaxelForces`` message."""
    m = message
    return Forces(
        sequence=m.sequence,
        captured_ns=m.captured_ns,
        wall_ns=_wall_ns(m.header),
        force=m.force.reshape(-1, 3),
        bound=m.normal_bound,
        status=m.status,
        array_taxels=tuple(m.array_taxels.tolist()),
        compensated=m.compensated,
        calibrated=m.calibrated,
    )


def field(message: Any) -> Field:
    """Convert a ``TaxelField`` message."""
    m = message
    return Field(
        m.sequence,
        m.captured_ns,
        _wall_ns(m.header),
        m.field_ut.reshape(-1, 3),
        m.temperature_c,
        tuple(m.array_taxels.tolist()),
    )


def ambient(message: Any) -> Ambient:
    """Convert an ``AmbientField`` message."""
    m = message
    return Ambient(
        m.sequence,
        m.captured_ns,
        _wall_ns(m.header),
        m.method,
        m.plane.reshape(-1, 3, 3)[:, :, 0],
        m.support,
        m.residual_ut,
        m.age,
        tuple(bool(each) for each in m.valid),
    )


def geometry(message: Any) -> Geometry:
    """Convert a ``SkinGeometry`` message."""
    m = message
    sizes = (m.array_rows.astype(int) * m.array_columns.astype(int)).tolist()
    arrays, start = [], 0
    for i, size in enumerate(sizes):
        arrays.append(
            ArrayLayout(
                m.array_name[i],
                SIDES.get(int(m.array_side[i]), "none"),
                int(m.array_rows[i]),
                int(m.array_columns[i]),
                bool(m.array_posed[i]) if i < len(m.array_posed) else True,
                slice(start, start + size),
            )
        )
        start += size
    return Geometry(
        m.model,
        m.serial_number,
        m.header.frame_id,
        tuple(arrays),
        m.position.reshape(-1, 3),
        m.normal.reshape(-1, 3),
        m.surface.reshape(-1, 2),
    )


def arm(message: Any) -> Arm:
    """Convert an ``ArmState`` message."""
    m = message
    return Arm(
        m.sequence,
        m.captured_ns,
        _wall_ns(m.header),
        m.x,
        m.y,
        m.heading,
        _planar(m.twist),
        (m.wrench.force.x, m.wrench.force.y, m.wrench.torque.z),
        m.mode,
        m.commander,
    )


def reach_state(message: Any) -> ReachState:
    """Convert a ``ReachState`` message."""
    m = message
    return ReachState(
        m.sequence,
        _wall_ns(m.header),
        m.state,
        m.activity,
        m.strategy,
        (m.goal.x, m.goal.y),
        m.goal_radius,
        m.distance,
        m.elapsed,
        _planar(m.wanted),
        _planar(m.commanded),
        m.armed,
        m.held,
        tuple(m.interventions),
    )
