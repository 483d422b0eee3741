"""The kernel of training for CUDA: one thread a reach, the same functions as on the CPU."""

from __future__ import annotations

import math
import time
from typing import Any, Final

from numba import config
from numba import cuda as numba_cuda

from tactile_tools.train.kernels import decide

cuda: Any = numba_cuda

REGISTERS: Final = 128
"""Of a thread at most: with more, too few warps fit side by side to wait for memory together."""

BLOCKS: Final = (8, 16, 32, 64)
"""Threads of a block that are tried. Worlds of one warp wait for the slowest of them, so that less
than a full warp of 32 may be faster."""

TRIES: Final = 3


_SIMULATED = bool(getattr(config, "ENABLE_CUDASIM", 0))
_LIMITS: dict[str, int] = (
    {} if _SIMULATED else {"max_registers": REGISTERS}
)  # the simulator has none


@cuda.jit(**_LIMITS)  # type: ignore[untyped-decorator, unused-ignore]
def decide_all(
    cycles: int, agents: Any, rings: Any, skin: Any, wanted: Any, worlds: Any, bodies: Any,
    outlines: Any, hulls: Any, contacts: Any, memory: Any, queues: Any, felt: Any, readout: Any,
) -> None:  # fmt: skip
    """`decide` of every reach."""
    w = cuda.grid(1)
    if w < worlds.shape[0]:
        decide(
            w, cycles, agents, rings, skin, wanted, worlds, bodies, outlines, hulls, contacts,
            memory, queues, felt, readout,
        )  # fmt: skip


class Launcher:
    """`decide_all` for ``n`` reaches; finds out which size of blocks is fastest while it works.

    The size changes nothing in what comes out.
    """

    def __init__(self, n: int) -> None:
        self._n, self._calls = n, 0
        self._took = dict.fromkeys(BLOCKS, math.inf)

    @property
    def threads(self) -> int:
        """Threads of a block, as far as is known now."""
        return min(self._took, key=self._took.__getitem__)

    def __call__(self, cycles: int, *arrays: Any) -> None:
        """Let all move on by so many control cycles."""
        # The first call compiles. Sizes take turns, since the load of the worlds changes.
        trial = self._calls - 1
        self._calls += 1
        if not 0 <= trial < TRIES * len(BLOCKS):
            self._launch(self.threads, cycles, arrays)
            return
        threads = BLOCKS[trial % len(BLOCKS)]
        cuda.synchronize()
        began = time.perf_counter()
        self._launch(threads, cycles, arrays)
        cuda.synchronize()
        self._took[threads] = min(self._took[threads], time.perf_counter() - began)

    def _launch(self, threads: int, cycles: int, arrays: tuple[Any, ...]) -> None:
        decide_all[math.ceil(self._n / threads), threads](cycles, *arrays)
