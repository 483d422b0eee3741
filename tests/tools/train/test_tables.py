"""One memory for kernels and PyTorch; the kernel of a GPU; what a strategy remembers, by both."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="no torch: pip install 'tactile-reach[learn]'")
pytest.importorskip("numba", reason="no numba: pip install 'tactile-reach[train]'")

import torch

from reachd.strategies.memory import LAGS, Memory
from tactile_tools.train.tables import Table

ROOT = Path(__file__).resolve().parents[3]
CPU = torch.device("cpu")


def test_kernel_and_tensors_see_the_same_records() -> None:
    kind = np.dtype([("count", np.int64), ("speed", np.float64), ("random", np.uint64)])
    start = np.zeros((2, 3), kind)
    start["random"] = 2**63 - 1
    table = Table(start, CPU)
    table["speed"] = torch.arange(6.0).reshape(2, 3)
    table.kernel["count"][1, 2] = -4
    assert table.kernel["speed"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert table["count"].tolist() == [[0, 0, 0], [0, 0, -4]]
    assert (table.kernel["random"] == 2**63 - 1).all()
    other = Table(np.zeros((4, 3), kind), CPU)
    other.take(torch.tensor([3, 0]), table, torch.tensor([1, 0]))
    assert other.kernel[3].tolist() == table.kernel[1].tolist()
    assert other.kernel[0].tolist() == table.kernel[0].tolist()
    assert not other.kernel[1:3]["random"].any()


def test_fields_that_are_no_words_are_refused() -> None:
    with pytest.raises(ValueError, match="8 bytes"):
        Table(np.zeros(2, [("small", np.int32), ("large", np.float64)]), CPU)


def test_memory_of_tensors_is_that_of_arrays() -> None:
    rng = np.random.default_rng(0)
    arrays, tensors = Memory(3), Memory(3, torch)
    for k in range(LAGS[-1] + 20):
        numbers = [rng.normal(size=(3, width)) for width in (9, 3, 3, 2, 5)]
        speeds = np.full((3, 2), 0.3)
        one = arrays.observe(*numbers, speeds)
        other = tensors.observe(*(torch.from_numpy(n) for n in (*numbers, speeds)))
        assert other.dtype == torch.float32
        assert other.numpy() == pytest.approx(one, abs=1e-6)
        if k == 7:
            pose = rng.normal(size=(1, 3))
            arrays.forget(np.array([1]), pose)
            tensors.forget(torch.tensor([1]), torch.from_numpy(pose))


MOVE = """
import json, sys
import numpy as np
from sim_device.world.scene_generation import generate
from tactile_tools.train.cupboards import Bank, Cupboards
from tactile_tools.train.settings import NO_VARIETY

bank = Bank([generate("authors_sim", 1_000_000 + k) for k in range(2)])
with Cupboards(bank, 2, np.random.default_rng(0), variety=NO_VARIETY, rows=[0, 1]) as reaches:
    agents, *_, readout = reaches.arrays
    agents["felt_any"] = 1
    agents["aside"] = 0.3
    if sys.argv[1] == "cuda":
        from numba import cuda
        from tactile_tools.train.kernels_cuda import Launcher

        arrays = [cuda.to_device(array) for array in reaches.arrays]
        launch = Launcher(2)
        for _ in range(3):
            launch(1, *arrays)
        agents, *_, readout = [array.copy_to_host() for array in arrays]
    else:
        for _ in range(3):
            reaches.run(1)
    print(json.dumps([agents["distance"].tolist(), agents["cycle"].tolist(), readout.tolist()]))
"""


def moved(device: str, **variables: str) -> list[list[float]]:
    done = subprocess.run(
        [sys.executable, "-c", MOVE, device],
        capture_output=True,
        text=True,
        env=os.environ | variables,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    found: list[list[float]] = json.loads(done.stdout)
    return found


def test_kernel_of_the_gpu_gives_what_the_processor_gives_in_the_simulator() -> None:
    """In Python, thread by thread: no GPU is needed. On a real one: `dev.gpu_check`."""
    simulated = moved("cuda", NUMBA_ENABLE_CUDASIM="1", NUMBA_DISABLE_JIT="1")
    for one, other in zip(simulated, moved("cpu"), strict=True):
        assert np.ravel(one) == pytest.approx(np.ravel(other), abs=1e-12)
    assert simulated[1] == [3, 3]
