"""Many cupboards at once in the planar engine: for training, planning and search.

The kernels are those of `PlanarWorld`, so that a world gives the same bits alone or among others.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from sim_device.world.base import PHYSICS_STEP, substeps
from sim_device.world.parameters import WorldParameters, world_parameters
from sim_device.world.planar_arrays import Arrays, arrays_of, poses_of, put, standing
from sim_device.world.planar_solver import (
    DISC,
    FALLEN,
    POLYGON,
    SLEEP_SPEED,
    SLEEP_STEPS,
    TURN_LENGTH,
    advance_some,
    place_all,
)
from sim_device.world.scenes import Scene
from tactile_core.arrays import FloatArray
from tactile_core.geometry import TIP_X, Side, finger
from tactile_core.types import record

Device = Literal["cpu", "cuda"]

CHUNKS: Final = 8
"""Parts in which a thread's share of the worlds is handed out: some take longer than others."""

CELL_M: Final = 1e-4
"""m to which places on the skin are told apart, as in the touch of single trials."""

FEATURES: Final = ("total_n", "tip_n", "peak_n", "peak_x_m", "peak_y_m")
"""Columns of `Worlds.features`: summed normal force, that on the tip, the greatest and its place
in ``ee``."""


@record
class Snapshot:
    """State of a cupboard from which to go on.

    ``finger`` (6,): pivot's x, y m, heading rad, vx, vy m/s, omega rad/s in ``cupboard``.
    ``wrench`` (3,): N, N, N·m that contacts exert on it. ``poses`` (n, 3): x, y m and yaw rad of
    the objects; ``speeds`` (n, 3): m/s, m/s, rad/s. ``standing`` (n,): whether each is on
    the shelf.
    """

    finger: FloatArray
    wrench: FloatArray
    poses: FloatArray
    speeds: FloatArray
    standing: NDArray[np.bool_]


_MOTION: Final = ("x", "y", "yaw", "vx", "vy", "omega")


class Worlds:
    """``n`` cupboards that are stepped together; arrays in, arrays out.

    ``scenes``: one for each world; the same scene may occur often. ``parameters``: None for the
    sets that the scenes name, else one for all. ``objects``: room for so many in each world, where
    later scenes have more (default: the most there are). ``device``: "cpu" shares the worlds out
    among ``threads`` (default: one a core); "cuda" gives each a thread of the GPU. RuntimeError
    where there is none.

    Single worlds do not raise `WorldError`: they are marked in ``failed``, and what they give is
    worth nothing until they are `reset`.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        parameters: WorldParameters | None = None,
        *,
        objects: int | None = None,
        device: Device = "cpu",
        threads: int | None = None,
    ) -> None:
        self._one = parameters
        self._scenes = list(scenes)
        figures = [self._figures(scene) for scene in scenes]
        self._host = arrays_of(scenes, figures, objects)
        self._goal = np.array([scene.goal for scene in scenes]).reshape(len(scenes), 2)
        self._radius = np.array([each.goal_radius for each in figures])
        self._reached = np.zeros(len(scenes), np.bool_)
        self._steps = np.zeros(len(scenes), np.int64)
        self._counts = np.array([len(scene.objects) for scene in scenes])
        self._device = _Gpu(self._host) if device == "cuda" else None
        if device not in ("cpu", "cuda"):
            raise ValueError(f"device {device!r}; allowed: cpu, cuda")
        self._threads = threads or os.cpu_count() or 1
        several = self._device is None and self._threads > 1
        self._pool = ThreadPoolExecutor(self._threads) if several else None

    def _figures(self, scene: Scene) -> WorldParameters:
        return self._one or world_parameters(scene.parameters)

    def __len__(self) -> int:
        """Worlds there are."""
        return len(self._scenes)

    def __enter__(self) -> Worlds:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End its threads."""
        if self._pool is not None:
            self._pool.shutdown()

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """What each was last built from."""
        return tuple(self._scenes)

    def step(self, dt: float, twists: FloatArray) -> None:
        """Advance all by ``dt`` s.

        ``twists``: (n, 3) m/s, m/s, rad/s in ``cupboard``, what each world's motors are asked for.
        ValueError where they are not finite or ``dt`` is not a multiple of `PHYSICS_STEP`.
        """
        steps, n = substeps(dt), len(self)
        wanted = np.asarray(twists, self._host.wanted.dtype)
        if wanted.shape != (n, 3):
            raise ValueError(f"twists of shape {wanted.shape}; there must be {(n, 3)}")
        if not np.isfinite(wanted).all():
            raise ValueError("a twist is not finite")
        self._host.wanted[:] = wanted
        if self._device is not None:
            self._device.step(steps)
        elif self._pool is not None:
            size = max(1, math.ceil(n / (self._threads * CHUNKS)))
            arrays = self._host.all
            parts = [
                self._pool.submit(advance_some, first, min(first + size, n), steps, *arrays)
                for first in range(0, n, size)
            ]
            for part in parts:
                part.result()
        else:
            advance_some(0, n, steps, *self._host.all)
        self._steps += steps
        self._reached |= self.distance <= self._radius

    def reset(self, index: int, scene: Scene | None = None) -> None:
        """Begin world ``index`` anew, with ``scene`` or with its own.

        ValueError where the scene has more objects than there is room for. On a GPU every call
        copies the arrays of all worlds there and back.
        """
        scene = self._scenes[index] if scene is None else scene
        figures = self._figures(scene)
        if self._device is not None:
            self._device.fetch(*_Gpu.BUILT)
        put(self._host, index, scene, figures)
        if self._device is not None:
            self._device.send(*_Gpu.BUILT)
        self._scenes[index] = scene
        self._goal[index], self._radius[index] = scene.goal, figures.goal_radius
        self._reached[index], self._steps[index] = False, 0
        self._counts[index] = len(scene.objects)

    def place(self, state: Snapshot) -> None:
        """Put all worlds, which must be of one scene, into ``state``; their time begins at 0.

        What is slower than `SLEEP_SPEED` rests until something touches it; forces of contacts are
        found anew in the first step. ValueError where scenes differ or ``state`` is of another.
        """
        first, count = self._scenes[0], len(state.poses)
        if count != len(first.objects) or any(scene != first for scene in self._scenes):
            raise ValueError(f"a state of {count} objects fits only worlds of that one scene")
        if self._device is not None:
            self._device.fetch(*_Gpu.BUILT)
        host = self._host
        body, world, out = host.bodies[0], host.worlds[:1], host.readout[0]
        finger, objects = body[:1], body[1 : count + 1]
        for name, value in zip(_MOTION, state.finger.tolist(), strict=True):
            finger[name] = value
        for column, name in enumerate(_MOTION[:3]):
            objects[name] = state.poses[:, column]
        for column, name in enumerate(_MOTION[3:]):
            objects[name] = state.speeds[:, column]
        for name in ("fx", "fy", "ft"):
            objects[name] = 0.0
        standing_as = np.where(objects["corners"] > 0, POLYGON, DISC)
        objects["kind"] = np.where(state.standing, standing_as, FALLEN)
        resting = (np.abs(state.speeds) * (1.0, 1.0, TURN_LENGTH)).max(axis=1) < SLEEP_SPEED
        objects["rest"] = np.where(resting, SLEEP_STEPS, 0)
        for name in ("remembered", "failed", "work"):
            world[name] = 0
        world["ejected"] = np.count_nonzero(~state.standing)
        for name, value in zip(("push_x", "push_y", "push_m"), state.wrench.tolist(), strict=True):
            world[name] = value
        place_all(0, host.bodies, host.outlines, host.hulls)
        out[:] = 0.0
        out[:6], out[6:9], out[10] = state.finger, state.wrench, world["ejected"][0]
        for array in (host.bodies, host.worlds, host.hulls, host.readout):
            array[1:] = array[0]
        if self._device is not None:
            self._device.send(*_Gpu.BUILT)
        self._steps[:] = 0
        self._reached[:] = self.distance <= self._radius

    def limit_wrench(self, f_max: float, m_max: float) -> None:
        """Bound all motors, as `World.limit_wrench`; a `reset` brings back a set's own bounds."""
        if not (0 < f_max < math.inf and 0 < m_max < math.inf):
            raise ValueError(f"wrench limits {f_max} N and {m_max} N·m are not finite and positive")
        if self._device is not None:
            self._device.fetch("worlds")
        self._host.worlds["f_max"], self._host.worlds["m_max"] = f_max, m_max
        if self._device is not None:
            self._device.send("worlds")

    @property
    def time(self) -> FloatArray:
        """(n,) simulated s since each was built or `reset`."""
        seconds: FloatArray = np.asarray(self._steps * PHYSICS_STEP, np.float64)
        return seconds

    @property
    def finger(self) -> FloatArray:
        """(n, 6) pivot's x, y m, heading rad, and vx, vy m/s, omega rad/s in ``cupboard``."""
        return self._host.readout[:, :6].copy()

    @property
    def wrench(self) -> FloatArray:
        """(n, 3) N, N, N·m on each finger about its pivot, averaged over the last step."""
        return self._host.readout[:, 6:9].copy()

    @property
    def ejected(self) -> NDArray[np.int64]:
        """(n,) objects that were pushed past the front edge and fell."""
        return self._host.readout[:, 10].astype(np.int64)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """(n,) whether the physics diverged or overflowed."""
        failed: NDArray[np.bool_] = self._host.readout[:, 11] != 0
        return failed

    @property
    def distance(self) -> FloatArray:
        """(n,) m from each tip to its goal."""
        x, y, heading = self._host.readout[:, :3].T
        dx = self._goal[:, 0] - x - TIP_X * np.cos(heading)
        dy = self._goal[:, 1] - y - TIP_X * np.sin(heading)
        return np.asarray(np.hypot(dx, dy), np.float64)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(n,) whether each tip was within its set's ``goal_radius`` at the end of any step."""
        return self._reached.copy()

    def contacts(self) -> tuple[FloatArray, NDArray[np.int64]]:
        """Contacts on the fingers, forces averaged over the last step.

        (n, t, 7) x, y m; outward normal x, y; force x, y N, all in ``ee``; body, an index into
        the scene's objects or `WALL`. (n,) how many rows of each world are in use.
        """
        if self._device is not None:
            self._device.fetch_felt()
        counts = self._host.readout[:, 9].astype(np.int64)
        rows = self._host.felt[:, : max(1, int(counts.max(initial=0))), 1:]
        return np.array(rows), counts

    def features(self) -> tuple[FloatArray, NDArray[np.int64]]:
        """What touch tells of the contacts: (n, 5) columns `FEATURES`, and (n,) the peak's `Side`.

        As the touch of single trials at depth ``contacts``: a contact is felt by the part of the
        skin whose taxel is nearest. 0 and `Side.NONE` where nothing touches.
        """
        rows, counts = self.contacts()
        used = np.arange(rows.shape[1]) < counts[:, np.newaxis]
        x, y, nx, ny, fx, fy = np.moveaxis(rows[:, :, :6], 2, 0)
        force = np.where(used, -(fx * nx + fy * ny), 0.0)
        sides = np.full(force.shape, int(Side.NONE))
        sides[used] = _sides(x[used], y[used])
        found = np.zeros((len(self), len(FEATURES)))
        # Added up in the order of the contacts, so that the last bit is that of a single trial.
        for column in range(force.shape[1]):
            found[:, 0] += force[:, column]
            found[:, 1] += np.where(sides[:, column] == int(Side.TIP), force[:, column], 0.0)
        peak = np.where(used, force, -1.0).argmax(axis=1)
        each, touched = np.arange(len(self)), counts > 0
        found[touched, 2] = force[each, peak][touched]
        found[touched, 3] = x[each, peak][touched]
        found[touched, 4] = y[each, peak][touched]
        return found, np.where(touched, sides[each, peak], int(Side.NONE))

    def poses(self) -> FloatArray:
        """(n, m, 3) x, y m and yaw rad of the objects in ``cupboard``; NaN where there is none."""
        bodies = self._bodies()
        poses = poses_of(bodies, bodies.shape[1] - 2)
        poses[np.arange(poses.shape[1]) >= self._counts[:, np.newaxis]] = math.nan
        return poses

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n, m) whether each object still stands on the shelf; False where there is none."""
        bodies = self._bodies()
        on = standing(bodies, bodies.shape[1] - 2)
        on &= np.arange(on.shape[1]) < self._counts[:, np.newaxis]
        return on

    def _bodies(self) -> NDArray[Any]:
        if self._device is not None:
            self._device.fetch("bodies")
        return self._host.bodies


def _sides(x: FloatArray, y: FloatArray) -> NDArray[np.int64]:
    """Part of the skin whose taxel is nearest to each place in ``ee``, m."""
    skin = finger()
    places = np.concatenate([a.position[:, :2] for a in skin.arrays])
    sides = np.array([int(a.side) for a in skin.arrays for _ in range(a.taxels)])
    middle_x = (np.floor(x / CELL_M) + 0.5) * CELL_M
    middle_y = (np.floor(y / CELL_M) + 0.5) * CELL_M
    away_x = places[:, 0] - middle_x[:, np.newaxis]
    away_y = places[:, 1] - middle_y[:, np.newaxis]
    nearest: NDArray[np.int64] = sides[(away_x**2 + away_y**2).argmin(axis=1)]
    return nearest


class _Gpu:
    """The arrays of ``host`` on a CUDA device; a step brings the readout back."""

    BUILT: Final = ("worlds", "bodies", "outlines", "hulls", "readout")
    """What a scene is built into."""

    def __init__(self, host: Arrays) -> None:
        from numba import cuda

        from sim_device.world import planar_cuda

        if not planar_cuda.available():
            raise RuntimeError(
                "no CUDA device was found: use device='cpu', or install the driver of the GPU"
            )
        self._host = host
        self._kernel, self._threads = planar_cuda.advance_all, planar_cuda.THREADS
        self._arrays = {name: cuda.to_device(getattr(host, name)) for name in host.names}
        self._felt_stale = False

    def step(self, steps: int) -> None:
        self.send("wanted")
        blocks = math.ceil(len(self._host.worlds) / self._threads)
        self._kernel[blocks, self._threads](steps, *self._arrays.values())
        self.fetch("readout")
        self._felt_stale = True

    def fetch_felt(self) -> None:
        """Bring the contacts back: of all that a step changes by far the most, and not always
        asked for."""
        if self._felt_stale:
            self.fetch("felt")
            self._felt_stale = False

    def send(self, *names: str) -> None:
        for name in names:
            self._arrays[name].copy_to_device(getattr(self._host, name))

    def fetch(self, *names: str) -> None:
        for name in names:
            self._arrays[name].copy_to_host(getattr(self._host, name))
