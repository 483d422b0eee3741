"""What may be seen of a world by whoever must not change it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_device.world.base import FingerState, World
from sim_device.world.parameters import WorldParameters
from sim_device.world.scenes import Scene
from tactile_core.arrays import FloatArray


class WorldView:
    """True state of ``world``, read-only: a privileged strategy is given this and nothing else."""

    def __init__(self, world: World) -> None:
        self._world = world

    @property
    def scene(self) -> Scene:
        """What the world was built from: shapes, sizes and masses of the objects."""
        return self._world.scene

    @property
    def parameters(self) -> WorldParameters:
        """Frictions, inertia and finger that it was built with."""
        return self._world.parameters

    def finger(self) -> FingerState:
        """Pose, twist and wrench of the finger."""
        return self._world.finger()

    def poses(self) -> FloatArray:
        """(n, 3) x, y m and yaw rad of each object in ``cupboard``, fallen ones included."""
        return self._world.poses().copy()

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n,) whether each object still stands on the shelf."""
        return self._world.on_shelf().copy()
