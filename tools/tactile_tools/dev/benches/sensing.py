"""Benchmarks of the sensing core: time of a cycle, consensus and RANSAC, forces while turning."""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Samples
from sim_device.skin.environment import (
    Environment,
    EnvironmentParameters,
    Surroundings,
    rotation_about,
)
from sim_device.skin.parameters import SkinParameters
from sim_device.skin.skin import SkinModel, nominal_calibration
from tactile_core.arrays import FloatArray
from tactile_core.calibration import ArrayCalibration, BoardCalibration
from tactile_core.geometry import Side, SkinGeometry, finger, grid_on_outline, grid_on_plane
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import SampleBlock
from tactiled.sensing import Method
from tactiled.sensing.consensus import Consensus
from tactiled.sensing.forces import ForceModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.pipeline import BoardPipeline
from tactiled.sensing.ransac_plane import fit_plane
from tactiled.sensing.settings import PipelineSettings

SERIAL = "00000000000000b5"
RATE_HZ = 100
ROTATION_AXIS = np.array([0.6, 0.48, 0.64])
"""Unit vector across all axes of ``ee``, so that every component of the field changes."""
ROTATION_S = 10.0
LSB_XY_UT, LSB_Z_UT = 0.300, 0.484  # MLX90393 at gain 4


def four_by_sixteen() -> SkinGeometry:
    """Four arrays of 4 × 4 taxels around the finger's outline: both sides, both shoulders."""
    pitch = (0.0165, 0.016)
    return SkinGeometry(
        "bench",
        "ee",
        tuple(
            grid_on_outline(name, side, (4, 4), pitch, centre)
            for name, side, centre in (
                ("right", Side.RIGHT, 0.055),
                ("right_shoulder", Side.RIGHT, 0.125),
                ("left_shoulder", Side.LEFT, 0.203),
                ("left", Side.LEFT, 0.273),
            )
        ),
    )


def bench_pipeline(
    *, quick: bool = False, cycles: int | None = None, method: Method = "consensus", seed: int = 0
) -> dict[str, float]:
    """Milliseconds from the bytes of one cycle to its features, 4 arrays × 16 taxels.

    Every tenth cycle begins or ends a press of 2 N that covers a quarter of an array, so that
    half of the cycles have contacts and patches.
    """
    cycles = cycles or (1000 if quick else 5000)
    rng = np.random.default_rng(seed)
    geometry = four_by_sixteen()
    model = SkinModel(geometry, SkinParameters(), rng)
    pipeline = BoardPipeline(nominal_calibration(model, SERIAL), PipelineSettings(method=method))
    environment = Environment(EnvironmentParameters(self_heating_k=0.0))
    forces = np.zeros((geometry.taxels, 3))
    stream: list[bytes] = []
    for k in range(200):
        if k % 10 == 0:
            forces[:] = 0.0
            if k % 20 == 0:
                forces[rng.choice(16, 4, replace=False) + 16 * rng.integers(4), 2] = -2.0
        turn = rotation_about(ROTATION_AXIS, 2 * np.pi * k / 200)
        counts = _counts(model, forces, environment.at(0.0, turn), rng)
        stream.append(
            b"".join(_frame(a, k, counts[part]) for a, part in enumerate(geometry.slices))
        )
    decoder = SerialDecoder()
    scale = np.array([LSB_XY_UT, LSB_XY_UT, LSB_Z_UT])
    took = []
    collecting = gc.isenabled()
    gc.disable()
    try:
        for k in range(cycles + 200):
            chunk = stream[k % 200]
            now = Instant(k * NS_PER_S // RATE_HZ)
            start = time.perf_counter()
            done = 0
            for received in decoder.feed(chunk):
                message = received.message
                if isinstance(message, Samples):
                    block = SampleBlock(
                        message.array,
                        k,
                        now,
                        now,
                        1e-4,
                        message.field * scale,
                        np.array([message.temperature_cc * 0.01]),
                        message.status,
                    )
                    done += len(pipeline.feed(block))
            took.append(time.perf_counter() - start)
            if done != 1:
                raise RuntimeError(f"cycle {k} gave {done} results instead of one")
    finally:
        if collecting:
            gc.enable()
    milliseconds = np.array(took[200:]) * 1e3
    return {
        "pipeline_ms_p50": float(np.percentile(milliseconds, 50)),
        "pipeline_ms_p99": float(np.percentile(milliseconds, 99)),
    }


def bench_consensus(
    *, quick: bool = False, surfaces: int | None = None, repeats: int = 5, seed: int = 0
) -> dict[str, float]:
    """Compare consensus with scikit-learn's default RANSAC on the same surfaces, in one run.

    ``surfaces`` cycles of four 4 × 4 arrays for each of 0, 25 and 45 % of the taxels in contact:
    planes of 50 µT and ± 100 µT/m, noise of real chips, contacts of 0.5–5 N at 152 µT/N with 30 %
    shear. Residual: rms of the taxels free of contact about the plane found. ``_plane_error``: rms
    over all taxels of the plane found about the true one.
    """
    surfaces = surfaces or (4 if quick else 20)
    rng = np.random.default_rng(seed)
    layout, consensus = _flat_fitter()
    places = layout.design[0, 1:].T
    out: dict[str, float] = {}
    ours, theirs = [], []
    for percent in (0, 25, 45):
        squares = np.zeros((2, 2))  # [consensus, RANSAC] × [residual, plane error]
        for _ in range(surfaces):
            truth, field, free = _surfaces(rng, layout, percent / 100)
            start = time.perf_counter()
            for _ in range(repeats):
                fit = consensus.fit(field, np.zeros_like(field), layout.real)
            ours.append((time.perf_counter() - start) / repeats)
            planes = [fit.theta, np.zeros_like(fit.theta)]
            start = time.perf_counter()
            for a in range(layout.arrays):
                for component in range(3):
                    found = fit_plane(places, field[a, component], rng, plain=True)
                    if found is not None:
                        planes[1][a, component] = found
            theirs.append(time.perf_counter() - start)
            for row, theta in enumerate(planes):
                found_field = theta @ layout.design
                squares[row, 0] += ((field - found_field) ** 2 * free[:, None]).sum() / free.sum()
                squares[row, 1] += ((found_field - truth) ** 2).sum() / free.size
        rms = np.sqrt(squares / (3 * surfaces))
        out[f"consensus_residual_ratio_{percent}"] = float(rms[0, 0] / rms[1, 0])
        out[f"consensus_residual_ut_{percent}"] = float(rms[0, 0])
        out[f"ransac_residual_ut_{percent}"] = float(rms[1, 0])
        out[f"consensus_plane_error_ut_{percent}"] = float(rms[0, 1])
        out[f"ransac_plane_error_ut_{percent}"] = float(rms[1, 1])
    out["consensus_residual_ratio"] = max(
        out[f"consensus_residual_ratio_{percent}"] for percent in (0, 25, 45)
    )
    out["consensus_ms"] = float(np.median(ours) * 1e3)
    out["ransac_ms"] = float(np.median(theirs) * 1e3)
    out["consensus_speedup"] = out["ransac_ms"] / out["consensus_ms"]
    return out


@dataclass(frozen=True, slots=True)
class _Turn:
    """One turn of the board under steady contacts, cycle by cycle.

    ``forces``: (T, N, 3) N measured. ``truth``: (N, 3) N. ``pressed``: (N,) bool. ``still``:
    (N, 3) N, what the same skin gives without ambient field and noise. ``valid``: share of cycles.
    """

    forces: FloatArray
    truth: FloatArray
    pressed: NDArray[np.bool_]
    still: FloatArray
    valid: float


def bench_rotation(
    *,
    quick: bool = False,
    steps: int | None = None,
    contact_sets: int | None = None,
    methods: tuple[Method, ...] | None = None,
    seed: int = 0,
) -> dict[str, float]:
    """False forces while the board turns through 360° in 50 µT, uncompensated and compensated.

    0, 25 and 50 % of each array's taxels of the default finger are pressed with 0.5–5 N and 30 %
    shear, in ``contact_sets`` random choices. Keys, for percent p: ``rotation_METHOD_rms_n_p``: rms
    over the free taxels' force components, with noise; ``rotation_METHOD_systematic_n_p``: the same
    without the chips' noise; ``rotation_contact_bias_pct_p``: mean size of the error of the pressed
    taxels' normal force, without noise, against the same skin without ambient field, in % of the
    force; ``rotation_contact_true_bias_pct_p``: against the true force, which includes the
    curvature of the dipole law. ``quick`` leaves RANSAC out.
    """
    steps = steps or (90 if quick else 360)
    contact_sets = contact_sets or (1 if quick else 2)
    methods = methods or (("off", "consensus") if quick else ("off", "ransac", "consensus"))
    out: dict[str, float] = {}
    skins = [(seed + 17 * k, _calibrated(seed + 17 * k)) for k in range(contact_sets)]
    for percent in (0, 25, 50):
        for method in methods:
            for noisy in (True, False):
                turns = [
                    _turn(percent / 100, method, noisy, steps, skin, calibration)
                    for skin, calibration in skins
                ]
                label = "uncompensated" if method == "off" else method
                kind = "rms" if noisy else "systematic"
                false = np.concatenate([(t.forces - t.still)[:, ~t.pressed].ravel() for t in turns])
                out[f"rotation_{label}_{kind}_n_{percent}"] = float(np.sqrt((false**2).mean()))
                if noisy:
                    out[f"rotation_{label}_valid_{percent}"] = float(
                        np.mean([t.valid for t in turns])
                    )
                if percent and not noisy:
                    bias = np.concatenate([_relative(t, t.still) for t in turns])
                    true_bias = np.concatenate([_relative(t, t.truth) for t in turns])
                    prefix = "rotation_contact" if method == "consensus" else f"rotation_{label}"
                    out[f"{prefix}_bias_pct_{percent}"] = 100 * float(np.abs(bias).mean())
                    out[f"{prefix}_true_bias_pct_{percent}"] = 100 * float(np.abs(true_bias).mean())
    return out


def _relative(turn: _Turn, reference: FloatArray) -> FloatArray:
    """Relative error of each pressed taxel's normal force at every step, in one row."""
    error: FloatArray = (turn.forces[:, turn.pressed, 2] / reference[turn.pressed, 2] - 1).ravel()
    return error


def _calibrated(seed: int) -> BoardCalibration:
    """Calibration of the skin that `_turn` makes of ``seed``: its tolerances are drawn first."""
    return nominal_calibration(
        SkinModel(finger(), SkinParameters(), np.random.default_rng(seed)), SERIAL
    )


def _turn(
    share: float, method: Method, noisy: bool, steps: int, seed: int, calibration: BoardCalibration
) -> _Turn:
    """Turn the default finger once with a share of every array's taxels pressed."""
    rng = np.random.default_rng(seed)
    geometry = finger()
    parameters = SkinParameters()
    if not noisy:
        parameters = replace(
            parameters, chip=replace(parameters.chip, noise_xy_ut=0.0, noise_z_ut=0.0)
        )
    model = SkinModel(geometry, parameters, rng)
    settings = PipelineSettings(method=method, frozen_after_s=None)
    pipeline = BoardPipeline(calibration, settings)
    room = EnvironmentParameters(self_heating_k=0.0, room_c=parameters.chip.reference_c)
    environment = Environment(room)
    truth = np.zeros((geometry.taxels, 3))
    for part in geometry.slices:
        count = round(share * (part.stop - part.start))
        chosen = part.start + rng.choice(part.stop - part.start, count, replace=False)
        normal = rng.uniform(0.5, 5.0, count)
        angle = rng.uniform(0, 2 * np.pi, count)
        truth[chosen, 0] = 0.3 * normal * np.cos(angle)
        truth[chosen, 1] = 0.3 * normal * np.sin(angle)
        truth[chosen, 2] = -normal
    pressed: NDArray[np.bool_] = np.any(truth != 0, axis=1)
    forces = np.empty((steps, geometry.taxels, 3))
    valid = 0
    for k in range(steps):
        turn = rotation_about(ROTATION_AXIS, 2 * np.pi * k / steps)
        counts = _counts(model, truth, environment.at(0.0, turn), rng)
        now = Instant(round(k * ROTATION_S / steps * NS_PER_S))
        cycle = None
        for a, part in enumerate(geometry.slices):
            block = SampleBlock(
                a,
                k,
                now,
                now,
                1e-4,
                counts[part] * model.chips.lsb_ut[part],
                np.array([25.0]),
                np.zeros(part.stop - part.start, np.uint8),
            )
            for cycle in pipeline.feed(block):
                forces[k] = cycle.force
                valid += bool(cycle.ambient.valid.all())
    # the same skin under the same load without ambient field, by the same calibration
    matrix_in = model.settled_field_ut(truth, 25.0) - model.settled_field_ut(0 * truth, 25.0)
    still = np.concatenate(
        [
            (array.newton_per_ut @ matrix_in[part].ravel()).reshape(-1, 3)
            for array, part in zip(calibration.arrays, geometry.slices, strict=True)
        ]
    )
    return _Turn(forces, truth, pressed, still, valid / steps)


def _counts(
    model: SkinModel, force: FloatArray, surroundings: Surroundings, rng: np.random.Generator
) -> NDArray[np.int16]:
    """Counts (N, 3) of the skin under settled taxel forces."""
    displacement = model.elastomer.settled(force)
    seen = model.field_ut(displacement, surroundings)
    return model.chips.convert(seen, surroundings.temperature_c, rng).counts


def _frame(array: int, sequence: int, counts: NDArray[np.int16]) -> bytes:
    return encode_serial(
        Samples(
            array=array,
            sequence=sequence,
            ticks=sequence * 10_000,
            temperature_cc=2500,
            field=counts,
            status=np.zeros(len(counts), np.uint8),
        )
    )


def _flat_fitter() -> tuple[Layout, Consensus]:
    """Four flat 4 × 4 arrays and the fit over them, forces not coupled."""
    axes = np.eye(3)
    geometry = SkinGeometry(
        "flat",
        "ee",
        tuple(
            grid_on_plane(f"array{a}", Side.TIP, (4, 4), (0.016, 0.016), (0.1 * a, 0, 0), axes)
            for a in range(4)
        ),
    )
    calibration = BoardCalibration(
        SERIAL,
        "flat",
        "ee",
        "1970-01-01T00:00:00Z",
        "bench",
        False,
        tuple(
            ArrayCalibration(g, np.zeros((16, 3)), np.zeros((16, 3)), 25.0, np.eye(48) / 152.0)
            for g in geometry.arrays
        ),
    )
    layout = Layout(geometry)
    return layout, Consensus(layout, ForceModel(calibration, layout))


def _surfaces(
    rng: np.random.Generator, layout: Layout, share: float
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """True ambient and measured field, (A, 3, n) µT, and which taxels are free, (A, n)."""
    theta = np.empty((layout.arrays, 3, 3))
    uniform = rng.normal(size=3)
    theta[:, :, 0] = 50.0 * uniform / np.linalg.norm(uniform)
    theta[:, :, 1:] = rng.uniform(-100, 100, (layout.arrays, 3, 2)) * layout.scale[:, None, None]
    truth = theta @ layout.design
    field = truth + rng.normal(size=truth.shape) * np.array([3.7, 3.7, 5.8])[:, None]
    free = np.ones((layout.arrays, layout.width), dtype=bool)
    for a in range(layout.arrays):
        count = round(share * layout.width)
        chosen = rng.choice(layout.width, count, replace=False)
        free[a, chosen] = False
        press = rng.uniform(0.5, 5.0, count) * 152.0
        angle = rng.uniform(0, 2 * np.pi, count)
        field[a, 0, chosen] += 0.3 * press * np.cos(angle)
        field[a, 1, chosen] += 0.3 * press * np.sin(angle)
        field[a, 2, chosen] += press
    return truth, field, free
