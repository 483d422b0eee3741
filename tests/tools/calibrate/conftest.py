"""Skins whose force is known in closed form, and recordings of a real board."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_core.calibration.nominal import nominal
from tactile_tools.calibrate.csv_pair import read_pair
from tactile_tools.calibrate.recording import Recording
from tests.support.paths import DATA

Float = NDArray[np.float64]

EFLESH = DATA / "eflesh"
PERIOD_S = 0.07
NORMAL = ("normal_force_20250401_014340", "normal_force_20250401_015037")
SHEAR = "shear_force_20250416_200533"
PLACE = "spatial_resolution_20250316_155729"


def displacement(time: Float, period: float = 20.0) -> Float:
    """Presses of varied depth with pauses: half sines, at rest for a third of the time."""
    phase = (time % period) / period
    depth = 1.0 + 0.4 * np.sin(1.7 * np.floor(time / period))
    wave: Float = depth * np.sin(np.pi * np.clip((phase - 0.2) / 0.6, 0, 1)) ** 2
    return wave


def skin_field(depth: Float, rng: np.random.Generator, noise_ut: float = 3.0) -> Float:
    """Field of five taxels, (m, 15) µT, over a rest of 10 mT.

    Each responds to the depth differently.
    """
    gain = np.array(
        [900, -300, 2000, 500, 700, -400, -600, 800, 1500, 300, -200, 900, 1000, 0, 400.0]
    )
    bend = np.linspace(-0.3, 0.3, 15)
    clean = 10_000.0 + depth[:, None] * gain + (depth**2)[:, None] * gain * bend
    return np.asarray(clean + rng.normal(size=clean.shape) * noise_ut)


@pytest.fixture(scope="session")
def make_recording() -> Callable[..., Recording]:
    """Recording of ``force(time, depth)`` with labels ``delay`` s late, every ``label_every`` s."""

    def make(
        force: Callable[[Float, Float], Float],
        *,
        delay: float = 0.0,
        seconds: float = 200.0,
        seed: int = 0,
        label_every: float = 0.2,
        period: float = 20.0,
        name: str = "synthetic",
    ) -> Recording:
        rng = np.random.default_rng(seed)
        time = np.arange(0.0, seconds, PERIOD_S)
        depth = displacement(time, period)
        label_time = np.arange(0.05, seconds - 1.0, label_every)
        labels = np.interp(label_time - delay, time, force(time, depth))
        return Recording(
            path=Path(name),
            geometry=nominal("anyskin", "synthetic", 5).geometry,
            serial_number="synthetic",
            started="2025-01-01T00:00:00+00:00",
            time_s=time,
            field_ut=skin_field(depth, rng),
            rest_ut=None,
            label_time_s=label_time,
            labels=labels[:, None],
            targets=("normal",),
        )

    return make


@pytest.fixture
def write_pair(tmp_path: Path) -> Callable[..., Path]:
    """Write a folder with a CSV pair of a plain skin.

    ``edit(sensor, states)`` may damage its lines.
    """

    def write(
        name: str = "normal_1",
        taxels: int = 5,
        rows: int = 200,
        edit: Callable[..., None] | None = None,
    ) -> Path:
        rng = np.random.default_rng(1)
        time = np.arange(rows) * 0.1
        depth = displacement(time, 8.0)
        field = skin_field(depth, rng)[:, : 3 * taxels]
        sensor = [
            ",".join(repr(float(v)) for v in (1.7e9 + t, *row))
            for t, row in zip(time, field, strict=True)
        ]
        states = [
            f"{float(1.7e9 + t + 0.002)!r},315.0,-100.0,280.0,{-1 if i % 2 else float(1000 * d)}"
            for i, (t, d) in enumerate(zip(time, depth, strict=True))
        ]
        if edit is not None:
            edit(sensor, states)
        folder = tmp_path / name
        folder.mkdir()
        (folder / "sensor.csv").write_text("\n".join(sensor) + "\n")
        (folder / "states.csv").write_text("\n".join(states) + "\n")
        return folder

    return write


@pytest.fixture(scope="session")
def real() -> Callable[[str], Recording]:
    """Recording of the eFlesh rig by name, read once; `Recording` is immutable."""

    @cache
    def read(name: str) -> Recording:
        return read_pair(EFLESH / name)

    return read
