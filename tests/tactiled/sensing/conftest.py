"""Small skins, and streams of blocks for them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_core.calibration import ArrayCalibration, BoardCalibration
from tactile_core.geometry import Side, grid_on_plane
from tactile_core.types import Instant
from tactiled.blocks import Cycle, SampleBlock
from tactiled.sensing.pipeline import BoardPipeline

Float = NDArray[np.float64]

PERIOD_NS = 10_000_000
LEFT = np.column_stack([(1.0, 0, 0), (0, 0, -1.0), (0, 1.0, 0)])  # normal: +y of ee
RIGHT = np.column_stack([(1.0, 0, 0), (0, 0, 1.0), (0, -1.0, 0)])
TIP = np.column_stack([(0, 1.0, 0), (0, 0, 1.0), (1.0, 0, 0)])
UT_PER_N = 100.0


def board(
    shapes: tuple[tuple[int, int], ...] = ((4, 4), (4, 4), (4, 4)),
    coupling: float = 0.0,
    nominal: bool = False,
    chip_yaw: float = 0.0,
) -> BoardCalibration:
    """Left, right and tip arrays of 100 µT/N, in which a press raises the outward field; rest
    fields zero.

    ``coupling``: field that a press causes at the nearest taxels of its array, as a share of its
    own taxel's; falls with the cube of the distance.
    """
    parts = (
        ("left", Side.LEFT, (0.05, 0.03, 0.0), LEFT),
        ("right", Side.RIGHT, (0.05, -0.03, 0.0), RIGHT),
        ("tip", Side.TIP, (0.15, 0.0, 0.0), TIP),
    )
    arrays = []
    for (name, side, centre, axes), shape in zip(parts, shapes, strict=False):
        n = shape[0] * shape[1]
        grid = grid_on_plane(name, side, shape, (0.016, 0.016), centre, axes, np.full(n, chip_yaw))
        apart = np.linalg.norm(grid.surface[:, None] - grid.surface[None], axis=2) / 0.016
        response = np.where(apart > 0, coupling / np.maximum(apart, 1e-9) ** 3, 1.0)
        per_newton = np.kron(response, np.diag([UT_PER_N, UT_PER_N, -UT_PER_N]))
        arrays.append(
            ArrayCalibration(
                geometry=grid,
                rest_ut=np.zeros((n, 3)),
                drift_ut_per_k=np.zeros((n, 3)),
                reference_c=25.0,
                newton_per_ut=np.linalg.inv(per_newton),
            )
        )
    return BoardCalibration(
        serial_number="0011223344556677",
        model="test",
        frame="ee",
        created="2026-01-01T00:00:00Z",
        provenance="made up",
        nominal=nominal,
        arrays=tuple(arrays),
    )


def field_of(calibration: BoardCalibration, force: Float, ambient: Float | None = None) -> Float:
    """Field, (N, 3) µT in chip axes, of ``force`` (N, 3) N in taxel axes and a uniform ``ambient``
    field in ee."""
    out = []
    for array, part in zip(calibration.arrays, calibration.geometry.slices, strict=True):
        n = array.geometry.taxels
        field = np.linalg.solve(array.newton_per_ut, force[part].ravel()).reshape(n, 3)
        if ambient is not None:
            field = field + ambient @ array.geometry.rotation
        yaw = array.geometry.chip_yaw
        x, y = field[:, 0].copy(), field[:, 1].copy()
        field[:, 0] = np.cos(yaw) * x + np.sin(yaw) * y
        field[:, 1] = np.cos(yaw) * y - np.sin(yaw) * x
        out.append(field)
    return np.concatenate(out)


class Stream:
    """Feeds cycles to a pipeline at 100 Hz."""

    def __init__(self, pipeline: BoardPipeline) -> None:
        self.pipeline = pipeline
        self.parts = pipeline.calibration.geometry.slices
        self.sequence = 0

    @property
    def now(self) -> Instant:
        """Capture time of the cycle with the present sequence number."""
        return Instant(self.sequence * PERIOD_NS)

    def block(
        self,
        array: int,
        field: Float,
        status: NDArray[np.uint8] | None = None,
        temperature_c: float = 25.0,
    ) -> SampleBlock:
        """Make the present cycle's block of one array from the field (N, 3) of the whole board."""
        part = self.parts[array]
        n = part.stop - part.start
        return SampleBlock(
            array=array,
            sequence=self.sequence % 2**32,
            captured=self.now,
            received=Instant(self.now + 1_000_000),
            uncertainty=1e-4,
            field_ut=field[part].copy(),
            temperature_c=np.array([temperature_c]),
            status=np.zeros(n, np.uint8) if status is None else status[part],
        )

    def cycle(
        self,
        field: Float,
        status: NDArray[np.uint8] | None = None,
        without: tuple[int, ...] = (),
        temperature_c: float = 25.0,
    ) -> list[Cycle]:
        """Feed one cycle without the arrays ``without``, and go on to the next."""
        out: list[Cycle] = []
        for array in range(len(self.parts)):
            if array not in without:
                out += self.pipeline.feed(self.block(array, field, status, temperature_c))
        self.sequence += 1
        return out

    def one(
        self,
        field: Float,
        status: NDArray[np.uint8] | None = None,
        temperature_c: float = 25.0,
    ) -> Cycle:
        """Feed one whole cycle and return it."""
        (cycle,) = self.cycle(field, status, temperature_c=temperature_c)
        return cycle


@pytest.fixture(name="board")
def board_fixture() -> Callable[..., BoardCalibration]:
    return board


@pytest.fixture(name="field_of")
def field_of_fixture() -> Callable[..., Float]:
    return field_of


@pytest.fixture(name="stream")
def stream_fixture() -> type[Stream]:
    return Stream
