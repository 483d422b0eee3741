"""Rigid transforms between the cupboard's plane and a robot's base. Pure.

Frames: ``base`` of the robot; ``tool``, its tool centre; ``ee``, at the wrist pivot with x along
the finger, z up; ``cupboard``, origin at the middle of the front edge at the height in which the
pivot moves, x inside, y left, z up. ``T_ab`` takes coordinates in b to coordinates in a.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from armd.driver import Float, RobotState
from tactile_core.types import Twist

HOLD_RATE: Final = 1.0
"""1/s with which height, roll and pitch return to the plane."""

HOLD_SPEED: Final = 0.005
"""m/s of that at most."""

HOLD_TURN: Final = 0.05
"""rad/s of that at most."""

MIN_SPAN: Final = 0.05
"""m between touched points; nearer ones would make errors of a millimetre a degree and more."""

SQUARE: Final = math.radians(20)
"""How far the angle between the touched edges may be from a right one."""

UPRIGHT: Final = math.radians(30)
"""How far the shelf may lean before left and right are taken to be swapped."""


class FrameError(ValueError):
    """Points that do not make a frame; the message says which and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """``position`` (3,) m and ``rotation`` (3, 3) of one frame in another."""

    position: Float
    rotation: Float

    def __matmul__(self, other: Transform) -> Transform:
        """``T_ab @ T_bc`` is ``T_ac``."""
        return Transform(
            self.position + self.rotation @ other.position, self.rotation @ other.rotation
        )

    def inverse(self) -> Transform:
        """``T_ba`` of ``T_ab``."""
        back = self.rotation.T
        return Transform(-(back @ self.position), back)

    def point(self, at: Float) -> Float:
        """A point's coordinates in a, from those in b."""
        return self.position + self.rotation @ at


def rotation_matrix(vector: Float) -> Float:
    """(3, 3) of a rotation vector (3,), rad."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = (np.asarray(vector, dtype=np.float64) / angle).tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Float = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return turned


def rotation_vector(matrix: Float) -> Float:
    """(3,) rad of a rotation matrix (3, 3); of length 0 to π."""
    axis = np.array(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )
    sine, cosine = float(np.linalg.norm(axis)) / 2, (float(np.trace(matrix)) - 1) / 2
    angle = math.atan2(sine, cosine)
    if sine > 1e-6:
        return axis * (angle / (2 * sine))
    if cosine > 0:
        return axis / 2
    # Half a turn: the axis is the eigenvector of the eigenvalue 1.
    column = int(np.argmax(np.diag(matrix)))
    found = (matrix + np.eye(3))[:, column]
    return np.asarray(found / np.linalg.norm(found) * angle, dtype=np.float64)


def rotation_of(quaternion: Float) -> Float:
    """(3, 3) of a unit quaternion w, x, y, z."""
    w, vector = float(quaternion[0]), np.asarray(quaternion[1:4], dtype=np.float64)
    size = float(np.linalg.norm(vector))
    if size < 1e-12:
        return np.eye(3)
    return rotation_matrix(vector / size * (2 * math.atan2(size, w)))


def quaternion_of(rotation: Float) -> list[float]:
    """w, x, y, z of a rotation matrix."""
    vector = rotation_vector(rotation)
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return [1.0, 0.0, 0.0, 0.0]
    return [math.cos(angle / 2), *(vector / angle * math.sin(angle / 2)).tolist()]


def cross(a: Float, b: Float) -> Float:
    """Cross product of two (3,); numpy's own takes ten times as long."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def frame_from_points(origin: Float, inside: Float, left: Float, up: Float) -> Transform:
    """``T_base_cupboard`` from three touched points in the base, m; `FrameError`.

    ``origin``: middle of the front edge. ``inside``: a point deeper in the cupboard, straight
    behind it. ``left``: a point to the left of the line through both. ``up`` (3,): which way is up.
    """
    x, y = inside - origin, left - origin
    for name, way in (("inside", x), ("left", y)):
        length = float(np.linalg.norm(way))
        if length < MIN_SPAN:
            raise FrameError(
                f"the points origin and {name} lie {length * 1e3:.0f} mm apart; touch them at "
                f"least {MIN_SPAN * 1e3:.0f} mm apart"
            )
    x = x / np.linalg.norm(x)
    corner = math.acos(min(1.0, max(-1.0, float(x @ y / np.linalg.norm(y)))))
    if abs(corner - math.pi / 2) > SQUARE:
        raise FrameError(
            f"the ways from origin to inside and to left enclose {math.degrees(corner):.0f}°, not "
            "90°; touch a point straight behind the origin and one straight to its left"
        )
    z = cross(x, y)
    z = z / np.linalg.norm(z)
    lean = math.acos(min(1.0, max(-1.0, float(z @ up / np.linalg.norm(up)))))
    if lean > math.pi / 2:
        raise FrameError(
            "the points make a mirrored frame, with z downward: the point called left lies to the "
            "right, or `up` is wrong"
        )
    if lean > UPRIGHT:
        raise FrameError(
            f"the shelf would lean by {math.degrees(lean):.0f}°; touch the three points again, or "
            "set `up` of the frame to the direction that is up in the robot's base"
        )
    return Transform(np.asarray(origin, dtype=np.float64), np.stack([x, cross(z, x), z], axis=1))


@dataclass(frozen=True, slots=True)
class Planar:
    """The pivot as the cupboard sees it: m, rad, N and N·m in ``cupboard``, and what is held.

    ``height`` m over the plane; ``tilt`` rad between the finger's z and the cupboard's.
    """

    x: float
    y: float
    heading: float
    twist: Twist
    fx: float
    fy: float
    mz: float
    height: float
    tilt: float


class Plane:
    """The plane in which a pivot moves.

    ``cupboard``: ``T_base_cupboard``. ``pivot``: ``T_tool_ee``.
    """

    def __init__(self, cupboard: Transform, pivot: Transform) -> None:
        self.cupboard = cupboard
        self.pivot = pivot
        self._from_base = cupboard.inverse()

    def planar(self, state: RobotState) -> Planar:
        """Where the pivot is, how it moves and what pushes it; the wrench about the pivot."""
        rotation = state.rotation @ self.pivot.rotation
        lever = state.rotation @ self.pivot.position  # from the tool centre to the pivot
        turn = self._from_base.rotation
        at = self._from_base.point(state.position + lever)
        axes = turn @ rotation
        linear, angular = state.twist[:3], state.twist[3:]
        velocity = turn @ (linear + cross(angular, lever))
        force = state.wrench[:3]
        moment = turn @ (state.wrench[3:] - cross(lever, force))
        turned, pushed = turn @ angular, turn @ force
        up = axes[2, 2]
        return Planar(
            x=float(at[0]),
            y=float(at[1]),
            heading=math.atan2(axes[1, 0], axes[0, 0]),
            twist=Twist(float(velocity[0]), float(velocity[1]), float(turned[2])),
            fx=float(pushed[0]),
            fy=float(pushed[1]),
            mz=float(moment[2]),
            height=float(at[2]),
            tilt=math.acos(min(1.0, max(-1.0, float(up)))) if math.isfinite(up) else math.nan,
        )

    def velocity(self, twist: Twist, state: RobotState) -> Float:
        """(6,) of the tool centre in the base for the pivot's ``twist``, the robot being at
        ``state``; height, roll and pitch are led back to the plane."""
        lever = state.rotation @ self.pivot.position
        at = self._from_base.point(state.position + lever)
        up = self._from_base.rotation @ (state.rotation @ self.pivot.rotation[:, 2])
        rise = min(HOLD_SPEED, max(-HOLD_SPEED, -HOLD_RATE * float(at[2])))
        # cross(up, z): the turn that takes the finger's z to the cupboard's.
        roll, pitch = HOLD_RATE * float(up[1]), -HOLD_RATE * float(up[0])
        size = math.hypot(roll, pitch)
        scale = min(1.0, HOLD_TURN / size) if size > 0 else 1.0
        out = self.cupboard.rotation
        angular = out @ np.array([roll * scale, pitch * scale, twist.omega])
        linear = out @ np.array([twist.vx, twist.vy, rise])
        return np.concatenate([linear - cross(angular, lever), angular])
