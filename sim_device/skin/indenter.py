"""Scripted indenter: presses on the skin over time, from a TOML script (see docs/press.toml)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from sim_device.skin.elastomer import Contact
from tactile_core.arrays import FloatArray
from tactile_core.config import (
    Document,
    KeyPath,
    Millimetres,
    Newtons,
    Seconds,
    allowed_values,
    dotted,
    unit,
)
from tactile_core.geometry import ArrayGeometry, SkinGeometry, finger

MAX_NORMAL_N = 100.0
"""Largest normal force, N; the elastomer is crushed well before."""

MAX_SECONDS = 1e6
"""Longest time that a script may contain, s: eleven days."""

MAX_REPEATS = 1_000_000

MAX_OFF_SKIN_MM = 12.0
"""Distance from the nearest taxel, mm, up to which the skin bears all of a contact
(`full_reach`)."""

MAX_PAST_EDGE_MM = 7.0
"""Distance past the outermost taxels along each axis, mm: keeps a corner within that reach."""


Place = Annotated[Millimetres, Meta(ge=-1000, le=1000)]
Shear = Annotated[Newtons, Meta(ge=-MAX_NORMAL_N, le=MAX_NORMAL_N)]
Time = Annotated[Seconds, Meta(ge=0, le=MAX_SECONDS)]


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """Force that rises over ``ramp`` s, stays ``hold`` s, and falls over ``ramp`` s.

    ``contact`` carries the full force. Times in s; the press begins at ``start`` and comes
    ``repeat`` times, one every ``every`` s.
    """

    contact: Contact
    start: float
    ramp: float
    hold: float
    repeat: int
    every: float

    @property
    def end(self) -> float:
        """End of the last repetition, s."""
        return self.start + (self.repeat - 1) * self.every + 2 * self.ramp + self.hold

    def level(self, seconds: float) -> float:
        """Share of the full force at ``seconds``, 0 to 1."""
        since = seconds - self.start
        if since < 0:
            return 0.0
        since -= min(since // self.every, self.repeat - 1) * self.every
        remaining = 2 * self.ramp + self.hold - since
        if remaining <= 0:
            return 0.0
        if self.ramp == 0:
            return 1.0
        return min(1.0, since / self.ramp, remaining / self.ramp)


class Indenter:
    """Presses that may overlap in time; usable as the ``contacts`` of a board."""

    def __init__(self, presses: Sequence[Press], loop: float | None = None) -> None:
        """``loop``: s after which the script starts again; None: it is played once."""
        self.presses = tuple(presses)
        self.loop = loop

    @property
    def duration(self) -> float:
        """Time until the script ends or starts again, s."""
        return self.loop or max((p.end for p in self.presses), default=0.0)

    def contacts(self, seconds: float) -> list[Contact]:
        """Contacts ``seconds`` s after power-on."""
        if self.loop is not None:
            seconds %= self.loop
        out = []
        for press in self.presses:
            level = press.level(seconds)
            if level > 0:
                full = press.contact
                out.append(Contact(full.position, full.force * level, full.radius))
        return out

    def __call__(self, seconds: float) -> list[Contact]:
        """Same as `contacts`."""
        return self.contacts(seconds)


class PressTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[press]]``: one force on the skin. Where: either ``array`` or ``position_mm``."""

    array: Annotated[
        str | None,
        Meta(description="array of the skin: left, right or tip of the finger; skin of AnySkin"),
    ] = None
    u_mm: Annotated[
        Millimetres | None,
        Meta(description="point on the unrolled skin, from the array's middle, along it"),
    ] = None
    v_mm: Annotated[
        Millimetres | None, Meta(description="the same, up; both are 0 if left out")
    ] = None
    position_mm: Annotated[
        tuple[Place, Place, Place] | None,
        unit("mm"),
        Meta(description="or a point in `ee`; the press is along the nearest taxel's normal"),
    ] = None
    normal_n: Annotated[Newtons, Meta(gt=0, le=MAX_NORMAL_N, description="force into the skin")]
    shear_n: Annotated[
        tuple[Shear, Shear], unit("N"), Meta(description="force along the skin, along u and v")
    ] = (0.0, 0.0)
    radius_mm: Annotated[
        Millimetres, Meta(gt=0, le=50, description="radius of the patch of contact")
    ] = 4.0
    start_s: Annotated[Time, Meta(description="when it begins, after power-on")] = 0.0
    ramp_s: Annotated[Time, Meta(description="how long the force rises, and falls")] = 0.2
    hold_s: Annotated[Time, Meta(description="how long it stays")] = 1.0
    repeat: Annotated[int, Meta(ge=1, le=MAX_REPEATS, description="how often")] = 1
    every_s: Annotated[
        Time | None,
        Meta(description="from one beginning to the next; left out: 1 s after the last has ended"),
    ] = None


class ScriptFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A script of the simulated indenter."""

    loop_s: Annotated[
        Annotated[Seconds, Meta(gt=0, le=MAX_SECONDS)] | None,
        Meta(description="the script starts again after this long; left out: it is played once"),
    ] = None
    press: Annotated[
        tuple[PressTable, ...],
        Meta(min_length=1),
        allowed_values("at least one [[press]] table"),
    ]


def load_script(path: str | Path, geometry: SkinGeometry | None = None) -> Indenter:
    """Indenter of the script at ``path`` for a skin (default: the finger); `ConfigError`."""
    document = Document.read(path)
    file = document.convert(ScriptFile)
    geometry = geometry or finger()
    presses = [_press(document, i, press, geometry) for i, press in enumerate(file.press)]
    longest = max(p.end for p in presses)
    if file.loop_s is not None and longest > file.loop_s:
        raise document.wrong(("loop_s",), f"at least {longest:g} s, the last press's end")
    return Indenter(presses, file.loop_s)


def _press(document: Document, number: int, table: PressTable, geometry: SkinGeometry) -> Press:
    at: KeyPath = ("press", number)
    position, axes = _place(document, at, table, geometry)
    length = 2 * table.ramp_s + table.hold_s
    if length == 0:
        problem = "ramp_s and hold_s are both 0; allowed: one of them above 0"
        raise document.error((*at, "hold_s"), f"{dotted(at)}: {problem}")
    every = length + 1.0 if table.every_s is None else table.every_s
    if every < length:
        raise document.wrong((*at, "every_s"), f"at least {length:g} s, the length of the press")
    force = axes @ np.array([*table.shear_n, -table.normal_n])
    contact = Contact(position, force, table.radius_mm / 1000)
    return Press(contact, table.start_s, table.ramp_s, table.hold_s, table.repeat, every)


def _place(
    document: Document, at: KeyPath, table: PressTable, geometry: SkinGeometry
) -> tuple[FloatArray, FloatArray]:
    """Position (3,) m in ``ee``, and the axes (3, 3) of the skin there."""
    if table.position_mm is not None:
        for key in ("array", "u_mm", "v_mm"):
            if getattr(table, key) is not None:
                raise document.wrong((*at, key), "either position_mm, or array with u_mm and v_mm")
        position = np.array(table.position_mm) / 1000
        taxels = np.concatenate([a.position for a in geometry.arrays])
        rotations = np.concatenate([a.rotation for a in geometry.arrays])
        distance = np.linalg.norm(taxels - position, axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] * 1000 > MAX_OFF_SKIN_MM:
            taxel = ", ".join(f"{1000 * v:.1f}" for v in taxels[nearest])
            raise document.wrong(
                (*at, "position_mm"),
                f"up to {MAX_OFF_SKIN_MM:g} mm from the nearest taxel, at [{taxel}]",
                f"{1000 * distance[nearest]:.0f} mm from it",
            )
        return position, rotations[nearest]
    arrays = {a.name: a for a in geometry.arrays}
    names = ", ".join(arrays)
    if table.array is None:
        raise document.missing((*at, "array"), f"one of {names}; or give position_mm")
    if table.array not in arrays:
        raise document.wrong((*at, "array"), names)
    array = arrays[table.array]
    place = []
    for axis, key in enumerate(("u_mm", "v_mm")):
        value = getattr(table, key) or 0.0
        edge = array.surface[:, axis]
        low, high = 1000 * edge.min() - MAX_PAST_EDGE_MM, 1000 * edge.max() + MAX_PAST_EDGE_MM
        if not low <= value <= high:
            raise document.wrong((*at, key), f"a number from {low:g} to {high:g} mm")
        place.append(value / 1000)
    return on_surface(array, *place)


def on_surface(array: ArrayGeometry, u: float, v: float) -> tuple[FloatArray, FloatArray]:
    """Point (3,) m in ``ee`` at surface coordinates ``u``, ``v`` m, and the axes (3, 3) there.

    The skin is taken as flat around its nearest taxel.
    """
    step = np.array([u, v]) - array.surface
    nearest = int((step**2).sum(axis=1).argmin())
    axes = array.rotation[nearest]
    point: FloatArray = array.position[nearest] + axes[:, :2] @ step[nearest]
    return point, axes
