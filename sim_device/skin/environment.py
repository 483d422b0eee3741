"""Surroundings of a skin: the earth's field, its gradient, temperature, and scripted attitude."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tactile_core.arrays import FloatArray

AttitudeScript = Callable[[float], FloatArray]
"""From seconds since power-on to the rotation (3, 3) from ``ee`` to world axes."""

TemperatureScript = Callable[[float], float]
"""From seconds since power-on to the board's temperature, °C."""


@dataclass(frozen=True, slots=True)
class EnvironmentParameters:
    """Magnetic and thermal surroundings."""

    field_ut: float = 50.0
    """Magnitude of the field, µT; the earth's field is 25–65."""
    inclination: float = math.radians(60)
    """Angle of the field below the horizontal, rad; 60° is central Europe or the northern United
    States."""
    heading: float = 0.0
    """Angle from world x to magnetic north, about z, rad."""
    gradient_ut_per_m: float = 30.0
    """Gradient of the field along world x, µT/m: steel furniture at arm's length (assumed)."""
    room_c: float = 23.0
    """Room temperature, °C."""
    self_heating_k: float = 4.0
    """Temperature of a warm board above the room, K (assumed)."""
    self_heating_time: float = 300.0
    """Time constant of warming, s."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Environment at one instant. ``attitude`` (3, 3): ``ee`` to world axes.

    ``world_field_ut`` (3,) µT at the origin of ``ee`` and ``gradient`` (3, 3) µT/m, both in world
    axes; ``temperature_c`` of the board.
    """

    attitude: FloatArray = field(default_factory=lambda: np.eye(3))
    world_field_ut: FloatArray = field(default_factory=lambda: np.zeros(3))
    gradient: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    temperature_c: float = 25.0

    def field_ut(self, position: FloatArray) -> FloatArray:
        """Ambient field (n, 3) µT in ``ee`` at ``position`` (n, 3) m in ``ee``."""
        turn = self.attitude
        in_ee: FloatArray = (
            self.world_field_ut @ turn + position @ (turn.T @ self.gradient @ turn).T
        )
        return in_ee


def still(_seconds: float) -> FloatArray:
    """Attitude script of an end-effector that does not turn."""
    return np.eye(3)


class Environment:
    """Surroundings over time. ``attitude``: script used while a board is given no attitude.

    ``temperature``: script of the board's temperature, °C; None: it warms as the parameters say.
    """

    def __init__(
        self,
        parameters: EnvironmentParameters | None = None,
        attitude: AttitudeScript = still,
        temperature: TemperatureScript | None = None,
    ) -> None:
        p = self.parameters = parameters or EnvironmentParameters()
        self.attitude = attitude
        self.temperature = temperature or self._warming
        flat, down = p.field_ut * math.cos(p.inclination), p.field_ut * math.sin(p.inclination)
        self._field = np.array([flat * math.cos(p.heading), flat * math.sin(p.heading), -down])
        # No sources inside the skin: the gradient is symmetric and has no trace (Maxwell).
        self._gradient = p.gradient_ut_per_m * np.diag([1.0, -0.5, -0.5])

    def at(self, seconds: float, attitude: FloatArray | None = None) -> Surroundings:
        """Surroundings ``seconds`` after power-on; ``attitude`` (3, 3) overrides the script."""
        return Surroundings(
            self.attitude(seconds) if attitude is None else attitude,
            self._field,
            self._gradient,
            self.temperature(seconds),
        )

    def _warming(self, seconds: float) -> float:
        p = self.parameters
        return p.room_c - p.self_heating_k * math.expm1(-max(seconds, 0.0) / p.self_heating_time)


def rotation_about(axis: FloatArray, angle: float) -> FloatArray:
    """Rotation (3, 3) by ``angle`` rad about the unit vector ``axis`` (Rodrigues' formula)."""
    x, y, z = axis.tolist()
    s, c = math.sin(angle), 1.0 - math.cos(angle)
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )


_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_ROTATION = re.compile(
    rf"\s*(?P<angle>{_NUMBER})\s*(?P<unit>deg|rad)\s*/\s*(?P<seconds>{_NUMBER})?\s*s"
    rf"\s*(?:@\s*(?P<axis>[xyz]|{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}))?\s*"
)
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def check_rotation(text: str) -> str:
    """Return ``text`` if `parse_rotation` accepts it; ValueError."""
    parse_rotation(text)
    return text


def parse_rotation(text: str) -> AttitudeScript:
    """Steady turn such as ``90deg/10s``, ``0.2rad/s``, ``360deg/20s@y`` or ``90deg/s@1,0,1``.

    The axis is in world axes, by default z. ValueError says what is allowed.
    """
    allowed = (
        "allowed: ANGLEdeg/SECONDSs or ANGLErad/SECONDSs, then @x, @y, @z or @X,Y,Z for the axis "
        "(z when left out), such as 90deg/10s or 0.2rad/s@y"
    )
    match = _ROTATION.fullmatch(text)
    if match is None:
        raise ValueError(f"rotation {text!r} is not understood; {allowed}")
    angle = float(match["angle"])
    if match["unit"] == "deg":
        angle = math.radians(angle)
    seconds = float(match["seconds"] or 1)
    if not 0 < seconds < math.inf or not math.isfinite(angle):
        raise ValueError(f"rotation {text!r}: time must be above 0 s and all finite; {allowed}")
    name = match["axis"] or "z"
    axis = np.array(_AXES[name] if name in _AXES else [float(v) for v in name.split(",")])
    length = float(np.linalg.norm(axis))
    if not 0 < length < math.inf:
        raise ValueError(f"rotation {text!r}: the axis has no direction; {allowed}")
    axis = axis / length
    rate = angle / seconds
    return lambda elapsed: rotation_about(axis, rate * elapsed)
