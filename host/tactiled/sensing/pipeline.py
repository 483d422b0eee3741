"""The sensing core of one board: sample blocks in, cycles with forces and features out."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.calibration.types import BoardCalibration
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Ambient, Cycle, Features, Reason, SampleBlock, TaxelHealth
from tactiled.sensing import reasons as why
from tactiled.sensing.bounds import QUANTILE_95, Bounds
from tactiled.sensing.compensation import Compensator, Estimate
from tactiled.sensing.consensus import PLANE_TAXELS
from tactiled.sensing.features import FeatureExtractor
from tactiled.sensing.forces import ForceModel, NetStage
from tactiled.sensing.health import HealthMonitor, Masking
from tactiled.sensing.layout import Layout
from tactiled.sensing.methods import make_compensator
from tactiled.sensing.reasons import Fault
from tactiled.sensing.rest import (
    LateRest,
    RecordedRest,
    RestField,
    RestState,
    RestWatch,
    TareReport,
)
from tactiled.sensing.settings import PipelineSettings

# Grouping: the blocks of a board's arrays are joined into sampling cycles by sequence number.


HALF = 1 << 31
"""Sequence numbers are 32 bits and wrap: a step of less than half the range is forward."""
LATE_RUN = 8
"""Late blocks in a row, none of them repeated, after which the board must have restarted: links
reorder a block or two, while a restarted board stays late."""


@dataclass(slots=True)
class CycleCounters:
    """Counts of blocks and cycles since the pipeline was made.

    ``cycles``: cycles made, ``incomplete_cycles`` of them without all arrays; ``missing_blocks``:
    how many arrays they lacked. ``lost_cycles``: gaps in the sequence. Blocks not used:
    ``duplicate_blocks``, ``late_blocks`` (their cycle was already made), ``unknown_array``,
    ``wrong_shape``. ``restarts``: times the sequence started over.
    """

    cycles: int = 0
    incomplete_cycles: int = 0
    missing_blocks: int = 0
    lost_cycles: int = 0
    duplicate_blocks: int = 0
    late_blocks: int = 0
    unknown_array: int = 0
    wrong_shape: int = 0
    restarts: int = 0


@dataclass(slots=True)
class Group:
    """Blocks of one cycle; ``blocks`` has an entry for every array, None while missing."""

    sequence: int
    blocks: list[SampleBlock | None]
    present: int = field(default=0)


class Grouper:
    """Holds the blocks of the cycle under way, and nothing else."""

    def __init__(self, taxels: tuple[int, ...]) -> None:
        self._taxels = taxels
        self._open: Group | None = None
        self._last: int | None = None
        self._late_run = 0
        self.counters = CycleCounters()

    def feed(self, block: SampleBlock) -> list[Group]:
        """Cycles that this block completes or ends by belonging to a later one: at most two."""
        count = self.counters
        if not 0 <= block.array < len(self._taxels):
            count.unknown_array += 1
            return []
        if not _fits(block, self._taxels[block.array]):
            count.wrong_shape += 1
            return []
        out: list[Group] = []
        group = self._open
        if group is not None:
            step = _step(group.sequence, block.sequence)
            if step == 0:
                if group.blocks[block.array] is not None:
                    count.duplicate_blocks += 1
                    return []
            elif step < 0:
                return self._late(block)
            else:
                out.append(self._close(group))
                group = None
        if group is None:
            if self._last is not None:
                step = _step(self._last, block.sequence)
                if step <= 0:
                    return out + self._late(block)
                count.lost_cycles += step - 1
            group = self._open = Group(block.sequence, [None] * len(self._taxels))
        self._late_run = 0
        group.blocks[block.array] = block
        group.present += 1
        if group.present == len(self._taxels):
            out.append(self._close(group))
        return out

    def flush(self) -> list[Group]:
        """The cycle under way, even if incomplete; for the end of a stream."""
        return [] if self._open is None else [self._close(self._open)]

    def reset(self) -> None:
        """Forget the sequence and the cycle under way: the board has restarted."""
        self._open = None
        self._last = None
        self._late_run = 0

    def _close(self, group: Group) -> Group:
        self._open = None
        self._last = group.sequence
        self.counters.cycles += 1
        missing = len(group.blocks) - group.present
        if missing:
            self.counters.incomplete_cycles += 1
            self.counters.missing_blocks += missing
        return group

    def _late(self, block: SampleBlock) -> list[Group]:
        """Count a block that came too late; a run of them means that the board has restarted."""
        if block.sequence == self._last and self._open is None:
            self.counters.duplicate_blocks += 1
            return []
        self._late_run += 1
        if self._late_run < LATE_RUN:
            self.counters.late_blocks += 1
            return []
        self.counters.restarts += 1
        self.reset()
        return self.feed(block)


def _fits(block: SampleBlock, taxels: int) -> bool:
    return (
        block.field_ut.shape == (taxels, 3)
        and block.status.shape == (taxels,)
        and block.temperature_c.shape in ((1,), (taxels,))
    )


def _step(earlier: int, later: int) -> int:
    """Signed number of steps from one 32-bit sequence number to another."""
    return (later - earlier + HALF) % (1 << 32) - HALF


def gather_temperature(group: Group) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Temperatures of a cycle, °C: per array or per taxel, as sent; NaN for a missing array."""
    parts = [
        np.array([np.nan]) if b is None else np.asarray(b.temperature_c, np.float64)
        for b in group.blocks
    ]
    return np.concatenate(parts)


__all__ = ["BoardPipeline", "CycleCounters", "PipelineSettings", "RestState", "TareReport"]

Bool = NDArray[np.bool_]


class BoardPipeline:
    """Turns sample blocks of one board into cycles.

    Pure and deterministic: the same blocks give the same cycles bit for bit. Memory, and time per
    cycle, are constant.
    """

    def __init__(
        self, calibration: BoardCalibration, settings: PipelineSettings | None = None
    ) -> None:
        self.calibration = calibration
        self.settings = settings = settings or PipelineSettings()
        geometry = calibration.geometry
        self._layout = layout = Layout(geometry)
        self._model = ForceModel(calibration, layout)
        self._sizes = tuple(a.taxels for a in geometry.arrays)
        self._grouper = Grouper(self._sizes)
        self._monitor = HealthMonitor(
            layout,
            settings.frozen_after_s,
            settings.range_limit_ut,
            None if calibration.nominal else self._model.chip_rest(),
        )
        self._compensator: Compensator = make_compensator(settings, layout, self._model)
        self._features = FeatureExtractor(geometry, settings)
        self._masking = Masking(geometry)
        self._late = LateRest(settings.tare_s)
        self._net = NetStage(calibration.nets, layout)
        self._names = tuple(a.name for a in geometry.arrays)
        self._reference_c = [a.reference_c for a in calibration.arrays]
        self._tip_arrays = [i for i, a in enumerate(geometry.arrays) if a.side.name == "TIP"]
        # for small arrays the bound alone limits how long a fit may be held
        self._hold = np.where(layout.counts < PLANE_TAXELS, np.inf, settings.hold_s).tolist()
        self._bounds = Bounds(self._model, layout, calibration.nominal)
        self._watch = RestWatch(layout, self._model, [a.name for a in geometry.arrays])
        self._warmer: FloatArray = np.zeros(layout.taxels)
        self._drift: FloatArray = np.zeros(layout.taxels)
        self._forgotten: Reason | None = None
        self._theta = np.zeros((layout.arrays, 3, 3))
        self._feature_due: Instant | None = None
        self._health: NDArray[np.uint8] = np.full(layout.taxels, TaxelHealth.MISSING, np.uint8)
        self._last_captured: Instant | None = None
        nothing = Ambient(
            method=settings.method,
            plane=np.zeros((layout.arrays, 3, 3)),
            support=np.zeros(layout.arrays),
            residual_ut=np.zeros(layout.arrays),
            age=np.full(layout.arrays, np.inf),
            valid=np.zeros(layout.arrays, dtype=bool),
        )
        zero = np.zeros(layout.arrays)
        self._unknown = Estimate(
            nothing.plane,
            nothing,
            np.zeros(layout.arrays, dtype=bool),
            np.full((layout.arrays, 3), np.inf),
            zero,
            zero,
            np.zeros_like(layout.real),
        )
        automatic = settings.auto_tare
        unrested = calibration.nominal or self._net.fitted
        known = not (unrested if automatic is None else automatic)
        self._rest = RestField(layout, self._model, settings, known)
        self._apply_noise(np.array(settings.noise_ut))
        if not known:
            self._rest.begin(self._noise)

    @property
    def counters(self) -> CycleCounters:
        """Counts of blocks and cycles so far."""
        return self._grouper.counters

    @property
    def health(self) -> NDArray[np.uint8]:
        """(N,) uint8 of `TaxelHealth` in the last cycle; all MISSING before the first."""
        return self._health

    @property
    def taring(self) -> bool:
        """Whether a tare is under way."""
        return self._rest.taring

    @property
    def tare_report(self) -> TareReport | None:
        """Report of the last tare that ended; None before the first."""
        return self._rest.report

    @property
    def rest_state(self) -> RestState:
        """State of the rest field."""
        return self._rest.state

    @property
    def rest_reason(self) -> Reason | None:
        """Why the rest field is suspect or was forgotten; None otherwise."""
        return self._rest.suspicion or self._forgotten

    def tare(self, force: bool = False) -> None:
        """Begin a tare: the mean field of the next cycles becomes the rest field.

        It ends within ten times ``tare_s``; `tare_report` then holds its result. It is refused,
        and nothing changes, when the field moves or a taxel bears more than ``tare_limit_n``; less
        than that cannot be told from the drift that taring corrects. ``force``: never refuse.
        """
        self._rest.begin(self._noise, force)

    def forget_rest(self, reason: Reason) -> None:
        """Drop the rest field and tare anew: the board or skin may have been exchanged."""
        self._forgotten = reason
        self.reset()
        self._rest.forget()
        self._rest.begin(self._noise)

    def rest_to_record(self) -> RecordedRest | None:
        """The rest field in use, for the log; None before the first tare."""
        rest = self._rest
        if not rest.known:
            return None
        return RecordedRest(
            rest.rest_ut.tolist(),
            rest.unrested.tolist(),
            self._noise.tolist(),
            rest.rough,
            rest.bare.tolist(),
            self._model.rested_c.tolist(),
        )

    def restore_rest(self, state: RecordedRest) -> None:
        """Use a recorded rest field; ValueError when it does not fit."""
        rest_ut, unrested = np.array(state.rest_ut), np.array(state.unrested, dtype=bool)
        noise = np.array(state.noise_ut)
        if rest_ut.shape != self._rest.rest_ut.shape or noise.shape != self._noise.shape:
            raise ValueError(f"a rest field of shape {rest_ut.shape} for another board")
        if unrested.shape != self._rest.unrested.shape or not np.isfinite(rest_ut).all():
            raise ValueError("a damaged rest field")
        self._rest.restore(rest_ut, unrested, state.rough)
        bare, rested_c = np.array(state.bare, dtype=bool), np.array(state.rested_c)
        if bare.shape == unrested.shape:
            self._rest.bare = bare
        if rested_c.shape == unrested.shape and np.isfinite(rested_c).all():
            self._settle_rest(rested_c)
        self._monitor.set_rest(self._model.chip_rest())
        self._apply_noise(noise)

    def reset(self) -> None:
        """Forget sequence, contacts and fits, but keep the rest field: the board has restarted."""
        self._grouper.reset()
        self._monitor.reset()
        self._compensator.reset()
        self._features.reset()
        self._masking.reset()
        self._net.pause()
        self._watch.reset()
        self._theta = np.zeros_like(self._theta)
        self._last_captured = None
        if self._rest.taring:
            self._rest.begin(self._noise)

    def feed(self, block: SampleBlock) -> list[Cycle]:
        """Process a block; returns the cycles that it ends: up to two, one of them incomplete."""
        return [
            self._cycle(group)
            for part in block.split(self._sizes)
            for group in self._grouper.feed(part)
        ]

    def flush(self) -> list[Cycle]:
        """The cycle under way, even if incomplete; for the end of a stream."""
        return [self._cycle(group) for group in self._grouper.flush()]

    def _cycle(self, group: Group) -> Cycle:
        layout, model = self._layout, self._model
        raw, temperature, status, present = self._collect(group)
        blocks = [block for block in group.blocks if block is not None]
        captured = min(block.captured for block in blocks)
        health = self._monitor.update(raw, temperature, status, present, captured)
        fault = self._monitor.fault
        rest = self._rest
        monitor = self._monitor
        if monitor.revived is not monitor.restored:  # usually both are the same all-False mask
            rest.unrested = (rest.unrested | monitor.revived) & ~monitor.restored
        known = rest.known  # read before taring: a first tare takes effect from the next cycle
        field = model.taxel_field(raw, temperature)
        if rest.taring and not (self._watch.off and rest.suspicion is not None):
            whole = bool(present.all())
            self._advance_tare(field, temperature, health, whole, captured, group.sequence)
        if known and np.count_nonzero(rest.unrested):
            health[rest.unrested] |= np.uint8(TaxelHealth.OUT_OF_RANGE)
            fault = np.where(rest.unrested & (fault == 0), np.uint8(Fault.UNRESTED), fault)
        if np.count_nonzero(rest.bare):
            health[rest.bare] |= np.uint8(TaxelHealth.OUT_OF_RANGE)
            fault = np.where(rest.bare & (fault == 0), np.uint8(Fault.NO_MAGNET), fault)
        field_of_all = field.copy() if np.count_nonzero(rest.bare) else field
        late = None
        if known and np.count_nonzero(rest.unrested) and not rest.taring:
            late = rest.unrested & (self._monitor.fault == 0)
            late_field = field - model.plane_field(self._theta)
        masked = int(np.count_nonzero(health))
        sick = masked > 0
        healthy = layout.real
        if sick:
            healthy = layout.real & (health == 0)
            # an unhealthy taxel's reading must not leak into its neighbours' forces
            np.copyto(field, model.plane_field(self._theta), where=~healthy[:, None])
        forces = model.forces(field)
        if known:
            in_ee = model.field_in_ee(field)
            estimate = self._compensator.update(in_ee, forces, healthy, captured)
            self._theta = estimate.theta
            if self.settings.method != "off":
                forces -= model.plane_forces(estimate.theta)
            if self._net.fitted and not sick:
                self._net.share(forces, self._net.update(field, captured))
            if np.count_nonzero(rest.bare):
                regained = self._watch.regained(field_of_all, rest.bare)
                if regained is not None:
                    rest.suspect(regained, self._noise)
            self._watch_rest(field, forces, estimate, healthy, captured)
            self._update_drift(temperature, healthy)
            if sick:
                np.copyto(forces, np.nan, where=~healthy[:, None])
        else:
            estimate = self._unknown
            masked = layout.taxels
            forces.fill(np.nan)
        force = layout.flat_vectors(forces)
        self._health = layout.flat(health)
        reasons, valid = self._reasons(estimate, healthy, present, known)
        if not all(block.clock_usable for block in blocks):
            reasons, valid = (why.CLOCK_UNUSABLE, *reasons), False
        if sick and known:
            normal = np.abs(force[:, 2])  # NaN where masked, so never above a threshold
            more, enough = self._masking.judge(layout.flat(fault), normal > self._features.least_n)
            reasons, valid = (*reasons, *more), valid and enough
        tip_usable = valid or (known and self._tip_usable(estimate, present))
        features = self._features.update(
            force, masked, reasons, valid, tip_usable, captured, layout.flat(estimate.loaded)
        )
        features, normal_bound = self._bound(features, estimate, force, known)
        if late is not None:
            self._rest_late(late_field, late, features.taxels_in_contact == 0, captured)
        if sick:
            self._masking.touched = self._features.contact
        else:
            self._masking.all_healthy(self._features.contact)
        if rest.taring:
            rest.note_peak(features.peak_force)
        if self.settings.rest_tracking_s is not None and valid and not reasons:
            self._track_rest(field, estimate, healthy, captured)
        follows = rest.recovers and known and not self._net.fitted
        if follows and rest.state is RestState.KNOWN and self._last_captured is not None:
            elapsed = max(0.0, (captured - self._last_captured) / NS_PER_S)
            left_over = field - self._model.plane_field(estimate.theta)
            rest.track_release(left_over, healthy, float(self._noise.max()), elapsed)
        self._last_captured = captured
        if sick:
            np.copyto(field, np.nan, where=~healthy[:, None])
        return Cycle(
            sequence=group.sequence,
            captured=captured,
            received=max(block.received for block in blocks),
            uncertainty=max(block.uncertainty for block in blocks),
            temperature_c=gather_temperature(group),
            field_ut=layout.flat_vectors(field),
            force=force,
            normal_bound=normal_bound,
            health=self._health,
            ambient=estimate.ambient,
            features=features,
            fault=layout.flat(fault),
            calibrated=not self.calibration.nominal,
            features_due=self._due(captured),
        )

    def _collect(self, group: Group) -> tuple[FloatArray, FloatArray, NDArray[np.uint8], Bool]:
        """Copy the blocks of a cycle into padded arrays; `False` in ``present``: array missing.

        Returns raw (A, 3, n) µT in chip axes, temperature (A, n) °C, status (A, n), present (A,).
        """
        shape = (self._layout.arrays, self._layout.width)
        raw = np.zeros((shape[0], 3, shape[1]))
        temperature = np.full(shape, 25.0)  # so that the padding is never out of range
        status = np.zeros(shape, np.uint8)
        present = np.ones(shape[0], dtype=bool)
        for a, block in enumerate(group.blocks):
            if block is None:
                present[a] = False
                continue
            n = len(block.status)
            raw[a, :, :n] = block.field_ut.T
            # Boards without thermometers are assumed to be as warm as at their calibration.
            told = block.temperature_c if block.thermometer else self._reference_c[a]
            temperature[a, :n] = told
            status[a, :n] = block.status
            if block.lsb_ut is not None:
                self._monitor.set_scale(a, block.lsb_ut)
        return raw, temperature, status, present

    def _reasons(
        self, estimate: Estimate, healthy: Bool, present: Bool, known: bool
    ) -> tuple[tuple[Reason, ...], bool]:
        """Why features are degraded, and whether they are still valid."""
        reasons: list[Reason] = []
        valid = True
        if not known:
            reasons.append(self._forgotten or why.TARING)
            valid = False
        elif self._rest.suspicion is not None:
            reasons.append(self._rest.suspicion)
            valid = False
        elif self._rest.rough:
            reasons.append(why.REST_UNCERTAIN)
            valid = False
        if np.count_nonzero(present) < len(present):
            reasons += [why.array_missing(self._names[a]) for a in np.flatnonzero(~present)]
            valid = False
        if healthy is not self._layout.real:
            masked = 1.0 - healthy.sum(axis=1) / self._layout.counts
            for a in np.flatnonzero((masked > self.settings.masked_limit) & present):
                reasons.append(why.taxels_masked(self._names[a], masked[a]))
                valid = False
            if self._net.fitted and known:
                reasons.append(why.MODEL_PAUSED)
        ambient = estimate.ambient
        if known and np.count_nonzero(ambient.valid) < len(present):
            for a in np.flatnonzero(~ambient.valid & present):
                name = self._names[a]
                if estimate.borrowed[a]:
                    reasons.append(why.compensation_borrowed(name))
                elif ambient.age[a] <= self._hold[a]:
                    reasons.append(why.compensation_held(name))
                else:
                    reasons.append(why.compensation_invalid(name))
                    valid = False
        return tuple(reasons), valid

    def _tip_usable(self, estimate: Estimate, present: Bool) -> bool:
        ambient = estimate.ambient
        return all(
            present[a]
            and (ambient.valid[a] or estimate.borrowed[a] or ambient.age[a] <= self._hold[a])
            for a in self._tip_arrays
        )

    def _advance_tare(
        self,
        field: FloatArray,
        temperature: FloatArray,
        health: NDArray[np.uint8],
        whole: bool,
        captured: Instant,
        sequence: int,
    ) -> None:
        """Add one cycle to the tare under way; at its end, contacts and fits are reset."""
        healthy = self._layout.real & (health == 0)
        usable = np.where(healthy[:, None], field, 0.0)
        before = self._model.rest
        stripped = self._rest.suspicion is not None
        shift = self._rest.advance(usable, healthy, whole, captured, sequence)
        report = self._rest.report
        if shift is None or report is None:
            return
        field -= shift
        if stripped:
            lost = self._watch.lost(before)
            self._rest.bare = lost | (self._rest.bare & ~self._watch.covered())
        self._forgotten = None
        self._monitor.set_rest(self._model.chip_rest())
        self._compensator.reset(rested=True)
        self._features.reset()
        self._masking.reset()
        self._net.reset()
        self._watch.reset()
        self._theta = np.zeros_like(self._theta)
        self._settle_rest(temperature)
        self._apply_noise(report.noise_ut)

    def _settle_rest(self, temperature: FloatArray) -> None:
        """Note that a rest field has just been set, at this temperature, (A, n) °C."""
        self._model.rested_at(temperature)
        self._bounds.set_rest(self._layout.flat_vectors(self._model.rest))

    def _watch_rest(
        self,
        field: FloatArray,
        forces: FloatArray,
        estimate: Estimate,
        healthy: Bool,
        captured: Instant,
    ) -> None:
        """Check whether the rest field is still right."""
        reason = self._watch.judge(field, forces, estimate, healthy, captured)
        if self._rest.rough:
            return  # a rough rest field is wrong anyway
        if reason is not None:
            self._rest.suspect(reason, self._noise)
        elif self._rest.suspicion is not None and self._watch.restored(forces, estimate, healthy):
            self._rest.clear_suspicion()

    def _update_drift(self, temperature: FloatArray, healthy: Bool) -> None:
        """Estimate the drift since the tare from the taxels' own thermometers."""
        # the thermometer of a masked chip cannot be trusted
        warmer = self._layout.flat(np.where(healthy, self._model.warmer(temperature), 0.0))
        if float(np.abs(warmer - self._warmer).max()) > WARMING_STEP_K:
            self._warmer = warmer.copy()
            self._drift = self._bounds.drift_sigma(warmer)
            self._set_thresholds()

    def _set_thresholds(self) -> None:
        """Set the contact thresholds above both noise and thermal drift."""
        self._features.set_noise(np.hypot(self._sigma, WARMING_SIGMAS * self._drift))

    def _bound(
        self, features: Features, estimate: Estimate, force: FloatArray, known: bool
    ) -> tuple[Features, FloatArray]:
        """Add bounds to the features, which are not valid where these are too wide.

        Returns them with the bounds of the taxels' normal forces, (N,) N.
        """
        if not known:
            return features, np.full(len(force), np.nan)
        bounds, extractor = self._bounds, self._features
        taxels = bounds.taxels(estimate, self._drift)
        unseen = float(extractor.least_n.max())
        odd = bounds.implausible(force)
        peak = float(taxels[extractor.peak_taxel]) + odd
        normal = bounds.together(extractor.summed, estimate, self._drift) + odd
        tip = bounds.together(extractor.tip_summed, estimate, self._drift) + odd
        limit = self.settings.bound_limit_n
        valid, reasons = features.valid, features.reasons
        if peak > limit or (bounds.few and normal > limit):
            valid = False
            reasons = (*reasons, self._main_uncertainty(max(peak, normal)))
        # added after the check of validity: contacts too slight to be detected do not matter to a
        # strategy that acts on half a newton
        if not extractor.summed:
            peak = math.hypot(peak, unseen)
        else:
            unseen *= BESIDE
        normal, tip = math.hypot(normal, unseen), math.hypot(tip, unseen)
        alone = bounds.apart(extractor.patch_summed, estimate, self._drift)
        patches = [
            dataclasses.replace(
                patch, bound=math.hypot(bound + odd, unseen) + bounds.scaled(patch.normal_force)
            )
            for patch, bound in zip(features.patches, alone, strict=True)
        ]
        features = dataclasses.replace(
            features,
            patches=tuple(patches),
            valid=valid,
            reasons=reasons,
            peak_force_bound=peak + bounds.scaled(features.peak_force),
            normal_force_bound=normal + bounds.scaled(features.normal_force),
            tip_force_bound=tip + bounds.scaled(features.tip_force),
        )
        normal_bound = taxels + bounds.scaled(1.0) * np.abs(force[:, 2])
        return features, normal_bound

    def _main_uncertainty(self, bound: float) -> Reason:
        """The reason for the largest part of the uncertainty."""
        warmest = float(self._warmer[np.argmax(np.abs(self._warmer))])
        if QUANTILE_95 * float(self._drift.max()) > 0.5 * self.settings.bound_limit_n:
            return why.too_warm(warmest)
        return why.uncertain(self._names[self._features_array()], bound)

    def _features_array(self) -> int:
        """Index of the array with the peak force."""
        ends = np.cumsum(self._layout.counts)
        return int(np.searchsorted(ends, self._features.peak_taxel, side="right"))

    def _rest_late(self, field: FloatArray, late: Bool, untouched: bool, captured: Instant) -> None:
        """Give chips that came late a rest field once nothing touches the skin."""
        if not (untouched and late.any()):
            self._late.forget()
            return
        shift = self._late.advance(field, late, self._noise, captured)
        if shift is not None:
            self._model.rest = self._model.rest + shift
            self._rest.unrested = self._rest.unrested & ~late
            self._monitor.set_rest(self._model.chip_rest())
            self._bounds.set_rest(self._layout.flat_vectors(self._model.rest))

    def _apply_noise(self, noise: FloatArray) -> None:
        """Set the thresholds of contact and fit from the noise of one sample, (3,) µT rms in chip
        axes."""
        self._noise = np.maximum(noise, MIN_NOISE_UT)
        self._monitor.set_noise(self._noise)
        self._sigma = self._layout.flat(self._model.normal_sigma(self._noise))
        self._bounds.set_noise(self._sigma)
        self._set_thresholds()
        self._compensator.set_noise(self._noise)

    def _track_rest(
        self, field: FloatArray, estimate: Estimate, healthy: Bool, captured: Instant
    ) -> None:
        """Let the rest field of untouched taxels track what compensation leaves."""
        period = self.settings.rest_tracking_s
        if period is None or self._last_captured is None:
            return
        share = min(1.0, (captured - self._last_captured) / NS_PER_S / period)
        free = healthy & ~self._layout.padded(self._features.contact)
        self._rest.track(field - self._model.plane_field(estimate.theta), free, share)

    def _due(self, captured: Instant) -> bool:
        """Whether to send this cycle's features, by ``feature_rate_hz``."""
        rate = self.settings.feature_rate_hz
        if rate is None:
            return True
        period = round(NS_PER_S / rate)
        if self._feature_due is None or captured < self._feature_due - 2 * period:
            self._feature_due = captured
        if captured < self._feature_due:
            return False
        behind = (captured - self._feature_due) // period
        self._feature_due = Instant(self._feature_due + (behind + 1) * period)
        return True


BESIDE = 0.5
"""Share of the detection threshold that undetected force beside a detected contact may have."""
WARMING_STEP_K = 0.5
"""K of warming after which bounds and thresholds are computed anew."""
WARMING_SIGMAS = 0.5
"""Weight of the unknown drift in a taxel's noise: contact then begins at 2.25 sigma of it."""
MIN_NOISE_UT = 0.3
"""µT, least noise assumed: an int16 of the finest scale alone makes 0.04, but chips differ by 3 %
in a field of tens of µT, which looks like noise to a fit."""
