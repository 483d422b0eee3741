"""Arrays of records as tensors: what kernels work on and PyTorch reads, in one memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

WORD = 8
"""Bytes of every field."""


class Table:
    """A copy of ``array`` on ``device``, seen as an array by kernels and as tensors by PyTorch.

    ``array``: of numbers, or of records whose fields are all 8 bytes long.

    `kernel` is what a kernel takes: a numpy array, or one of Numba's on the GPU. ``table[name]`` is
    a tensor of a field, ``table.tensor`` of all numbers, records being rows of 64-bit words.
    """

    def __init__(self, array: NDArray[Any], device: torch.device) -> None:
        self._fields: Mapping[str, Any] = array.dtype.fields or {}
        words = array.dtype.itemsize // WORD
        plain = np.ascontiguousarray(array)
        if self._fields:
            if any(kind.itemsize != WORD for kind, *_ in self._fields.values()):
                raise ValueError(f"fields of other than {WORD} bytes: {array.dtype}")
            plain = plain.view(np.float64).reshape(*array.shape, words)
        # Words are moved as they are, whatever they mean.
        self.tensor = torch.from_numpy(plain.copy()).to(device)
        if device.type == "cuda":
            from numba import cuda

            self.kernel: Any = cuda.as_cuda_array(self.tensor)  # type: ignore[no-untyped-call, unused-ignore]
        else:
            self.kernel = self.tensor.numpy()
        if self._fields:
            self.kernel = self.kernel.view(array.dtype).reshape(array.shape)

    def __getitem__(self, name: str) -> torch.Tensor:
        """Field ``name`` of every record; what is written to it is seen by kernels."""
        kind, offset, *_ = self._fields[name]
        words = self.tensor if kind == np.float64 else self.tensor.view(torch.int64)
        return words[..., offset // WORD]

    def __setitem__(self, name: str, values: Any) -> None:
        self[name][...] = values

    def take(self, which: torch.Tensor, other: Table, rows: torch.Tensor) -> None:
        """Copy the records ``rows`` of ``other`` to ``which``."""
        self.tensor[which] = other.tensor[rows]
