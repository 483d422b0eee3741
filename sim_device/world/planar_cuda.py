"""The planar engine's kernel for CUDA: one thread a world, the same functions as on the CPU."""

from __future__ import annotations

from typing import Any

from numba import cuda as numba_cuda

from sim_device.world.planar_solver import advance

cuda: Any = numba_cuda

THREADS = 64
"""Threads of a block: a world needs many registers."""


@cuda.jit  # type: ignore[untyped-decorator, unused-ignore]
def advance_all(
    steps: int,
    wanted: Any,
    worlds: Any,
    bodies: Any,
    outlines: Any,
    hulls: Any,
    contacts: Any,
    memory: Any,
    queues: Any,
    felt: Any,
    readout: Any,
) -> None:
    """`advance` of every world."""
    w = cuda.grid(1)
    if w < worlds.shape[0]:
        advance(
            w,
            steps,
            wanted,
            worlds,
            bodies,
            outlines,
            hulls,
            contacts,
            memory,
            queues,
            felt,
            readout,
        )


def available() -> bool:
    """Whether there is a device, or the simulator stands in for one (NUMBA_ENABLE_CUDASIM=1)."""
    return bool(cuda.is_available())
