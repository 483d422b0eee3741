"""A board of five magnetometers that all respond to a press: force, bound and rest field.

Rows 5, 7 and 48 of the fault table. Fields are a recorded board's rest field plus simulated events,
and go through the pipeline of an uncalibrated AnySkin in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_device.faults import FaultPlan
from sim_device.skin.environment import Environment, EnvironmentParameters, rotation_about
from sim_device.skin.parameters import anyskin_parameters
from sim_device.skin.sampler import Sampler
from sim_device.skin.skin import Contact, SkinModel
from tactile_core.calibration import nominal
from tactile_core.geometry import anyskin
from tactile_core.types import Instant
from tactile_tools.dev.benches.skin5 import TURN_AXIS, Board
from tactiled.blocks import Cycle, SampleBlock
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings, RestState
from tactiled.sensing.reasons import REPLUGGED

Float = NDArray[np.float64]
REST = np.array(
    [
        [-1391, 0, -1744],
        [41, -2, -514],
        [266, -788, -1335],
        [1933, 3962, -3840],
        [-577, 219, -1030],
    ],
    dtype=float,
)
OTHER_SKIN = REST * np.array([[0.8], [1.2], [0.9], [0.85], [1.1]]) + 60
BARE = np.full((5, 3), 20.0)
ARRAY = anyskin().arrays[0]
PLACE = np.column_stack([ARRAY.surface, np.zeros(5)])


class UserBoard:
    """The readings of a user's board, frame by frame."""

    def __init__(self, hz: float = 100.0, seed: int = 1) -> None:
        self.hz = hz
        self.pipeline = BoardPipeline(nominal("anyskin", ""), PipelineSettings())
        self.rng = np.random.default_rng(seed)
        self.frame = 0
        self.play(lambda _: REST, 1.0)

    def play(
        self,
        field_at: Callable[[float], Float],
        seconds: float,
        celsius_at: Callable[[float], float] = lambda _: 27.0,
    ) -> list[Cycle]:
        """Cycles of ``seconds`` in which the chips read ``field_at(s)`` plus noise."""
        out = []
        for k in range(round(seconds * self.hz)):
            t = k / self.hz
            noise = self.rng.normal(0, 1, (5, 3)) * (1.5, 1.5, 2.5)
            now = Instant(round(self.frame / self.hz * 1e9))
            celsius = np.round((celsius_at(t) + self.rng.normal(0, 0.05, 5)) * 45.2) / 45.2
            lsb = np.array([0.15, 0.15, 0.242])
            field = np.round((field_at(t) + noise) / lsb) * lsb
            block = SampleBlock(
                0, self.frame, now, now, 0.01, field, celsius, np.zeros(5, np.uint8)
            )
            out += self.pipeline.feed(block)
            self.frame += 1
        return out


def in_chips(field: Float) -> Float:
    """Convert (5, 3) µT in the skin's axes to chip axes: each chip is mounted with its own yaw."""
    c, s = np.cos(ARRAY.chip_yaw), np.sin(ARRAY.chip_yaw)
    x, y = field[:, 0], field[:, 1]
    return np.column_stack([c * x + s * y, -s * x + c * y, field[:, 2]])


def turning(t: float, rad_per_s: float = 1.0) -> Float:
    a = rad_per_s * t
    return in_chips(np.tile([50 * np.sin(a), 0.0, 50 * np.cos(a) - 50], (5, 1)))


def pressed(newton: dict[int, float]) -> Float:
    field = np.zeros((5, 3))
    for chip, force in newton.items():
        field[chip, 2] = 115.0 * force
    return field


def codes(cycles: list[Cycle]) -> set[str]:
    return {code for cycle in cycles for code in cycle.features.codes}


def share_within_bound(cycles: list[Cycle], newton: float) -> float:
    """Share of the cycles whose bound includes a normal force of ``newton``."""
    return float(
        np.mean(
            [abs(c.features.normal_force - newton) <= c.features.normal_force_bound for c in cycles]
        )
    )


@pytest.mark.parametrize("newton", [1.0, 3.0, 10.0])
def test_press_on_a_calibrated_board_reads_true_force(newton):
    board = Board(3)
    axes, centre = ARRAY.rotation[0], ARRAY.position[0]
    load = axes @ np.array([0.1 * newton, 0.0, -newton])

    def force(t):
        share = min(1.0, max(0.0, (t - 0.3) / 0.15))
        return board.skin.taxel_force([Contact(centre + 0.003 * axes[:, 0], share * load, 4e-3)])

    truth, cycles = board.run(force, lambda _: np.eye(3), 1.5)
    late = cycles[70:]
    read = np.mean([c.features.normal_force for c in late])
    assert read == pytest.approx(truth[-1], abs=max(0.25, 0.06 * truth[-1]))
    assert all(c.features.valid for c in late)
    # a single slight press may be off throughout; over all presses it is 97 %, see the bench
    assert share_within_bound(late, truth[-1]) > (0.95 if newton > 1.0 else 0.6)
    # and the force ends with the press
    _, after = board.run(lambda _: np.zeros((5, 3)), lambda _: np.eye(3), 1.0)
    assert after[-1].features.normal_force < 0.25


@pytest.mark.parametrize("chips", [[], [2], [0, 1, 2]])
def test_bounds_hold_while_the_board_turns_under_a_press(chips):
    user_board = UserBoard(hz=40.0)
    user_board.play(lambda t: REST + turning(t), 2.0)
    load = pressed(dict.fromkeys(chips, 2.0))
    cycles = user_board.play(lambda t: REST + turning(2.0 + t) + load, 6.0)
    assert share_within_bound(cycles, 2.0 * len(chips)) > 0.97
    if chips:
        peaks = [c.features.peak_force for c in cycles[20:]]
        assert np.median(peaks) == pytest.approx(2.0, abs=0.15)
    else:
        assert max(c.features.normal_force for c in cycles) < 0.1
        assert all(c.features.valid for c in cycles)


def test_taxel_bounds_grow_while_the_field_is_unobserved():
    board = Board(5)
    load = np.zeros((5, 3))
    load[:, 2] = -2.0
    _, cycles = board.run(
        lambda t: load * min(1.0, max(0.0, t - 0.5) / 0.15),
        lambda t: rotation_about(TURN_AXIS, max(0.0, t - 2.0)),
        6.0,
    )
    early, late = cycles[100], cycles[-1]
    assert early.normal_bound.shape == (5,)
    assert (late.normal_bound > early.normal_bound).all()
    assert "uncertain:skin" in codes(cycles[300:])
    assert not cycles[-1].features.valid


def test_jump_of_a_uniform_field_is_not_a_contact():
    user_board = UserBoard()
    leap = in_chips(np.tile([1200.0, -800.0, 1400.0], (5, 1)))
    on = user_board.play(lambda t: REST + leap * min(1.0, t / 0.2), 1.5)
    assert "field_jump" in codes(on)
    assert not any(c.features.valid and c.features.normal_force > 0.5 for c in on)
    assert user_board.pipeline.rest_state is RestState.SUSPECT
    text = next(r.text for r in on[-1].features.reasons if r.code == "field_jump")
    assert "on all taxels at once" in text
    assert "tare" in text
    off = user_board.play(lambda _: REST, 3.0)
    assert off[-1].features.valid
    assert off[-1].features.normal_force < 0.1
    assert user_board.pipeline.rest_state is RestState.KNOWN


@pytest.mark.parametrize("gain", [1.2, 0.8, 0.6])
def test_gain_change_is_detected_at_once_and_adopted(gain):
    user_board = UserBoard()
    cycles = user_board.play(lambda _: REST * gain, 3.0)
    assert cycles[0].features.codes[0] == "gain_changed"
    assert not any(c.features.valid and c.features.normal_force > 0.3 for c in cycles)
    assert cycles[-1].features.valid


def test_exchanged_skin_is_never_a_contact_and_is_adopted():
    user_board = UserBoard(hz=40.0)
    bare = user_board.play(lambda _: BARE, 2.0)
    assert codes(bare) >= {"skin_off:skin"}
    assert not any(c.features.valid for c in bare)
    other = user_board.play(lambda _: OTHER_SKIN, 4.0)
    assert not any(c.features.valid and c.features.normal_force > 0.3 for c in other)
    assert other[-1].features.valid
    assert user_board.pipeline.tare_report.accepted
    press = user_board.play(lambda _: OTHER_SKIN + pressed({2: 3.0}), 2.0)
    assert press[-1].features.normal_force == pytest.approx(3.0, abs=0.3)


def test_loose_magnet_leaves_its_taxel_masked():
    user_board = UserBoard(hz=40.0)
    lost = REST.copy()
    lost[2] = 20, 10, 30
    cycles = user_board.play(lambda _: lost, 4.0)
    assert not any(c.features.valid and c.features.normal_force > 0.3 for c in cycles)
    assert "magnet_lost:skin" in codes(cycles)
    assert np.isnan(cycles[-1].force[2]).all()
    assert np.isfinite(cycles[-1].force[[0, 1, 3, 4]]).all()


def test_warming_is_not_a_contact_and_widens_the_bound():
    user_board = UserBoard(hz=10.0)

    def warmer(t):
        return 20.0 * min(1.0, t / 60.0)

    offset = np.random.default_rng(2).normal(0, 0.5, (5, 3))
    cycles = user_board.play(
        lambda t: REST * (1 - 0.0012 * warmer(t)) + offset * warmer(t),
        70.0,
        lambda t: 27.0 + warmer(t),
    )
    assert not any(c.features.valid and c.features.normal_force > 0.3 for c in cycles)
    assert share_within_bound(cycles, 0.0) > 0.99
    assert "temperature_moved" in codes(cycles)
    assert not cycles[-1].features.valid
    user_board.pipeline.tare()
    after = user_board.play(lambda _: REST * (1 - 0.024) + offset * 20.0, 2.0, lambda _: 47.0)
    assert after[-1].features.valid


def test_tare_under_load_is_refused_unless_forced():
    user_board = UserBoard()
    load = REST + pressed({2: 4.0})
    user_board.play(lambda _: load, 1.0)
    user_board.pipeline.tare()
    user_board.play(lambda _: load, 1.0)
    report = user_board.pipeline.tare_report
    assert not report.accepted
    assert "force" in report.message
    assert user_board.play(lambda _: load, 0.3)[-1].features.normal_force > 3.0
    user_board.pipeline.tare(force=True)
    after = user_board.play(lambda _: load, 1.0)
    assert user_board.pipeline.tare_report.accepted
    assert after[-1].features.normal_force < 0.2


def test_possibly_exchanged_board_has_no_rest_field_until_tared():
    user_board = UserBoard()
    user_board.pipeline.forget_rest(REPLUGGED)
    cycles = user_board.play(lambda _: OTHER_SKIN, 1.5)
    assert cycles[0].features.codes[0] == "replugged"
    assert not any(c.features.valid and c.features.normal_force > 0.2 for c in cycles)
    assert cycles[-1].features.valid


def test_unrecovered_skin_strain_fades_and_is_not_a_lasting_contact():
    user_board = UserBoard(hz=25.0)
    user_board.play(lambda _: REST + pressed({0: 8.0, 1: 15.0, 2: 3.0, 3: 6.0, 4: 4.0}), 4.0)
    left = pressed({0: 0.3, 1: 0.7, 2: 0.2, 3: 0.3, 4: 0.2})  # 4 % of the peak
    cycles = user_board.play(lambda _: REST + left, 15.0)
    assert cycles[-1].features.normal_force < 0.3
    assert user_board.play(lambda _: REST + left, 3.0)[-1].features.valid


@pytest.mark.parametrize(
    ("spec", "code"),
    [
        ("leap=1500@2s+1s", "field_jump"),
        ("gain=0.6@2s", "gain_changed"),
        ("skinoff@2s+1.5s,newskin@2s", "skin_off:skin"),
        ("loose=skin:2@2s", "magnet_lost:skin"),
    ],
)
def test_simulator_plays_skin_events(spec, code):
    rng = np.random.default_rng(4)
    skin = SkinModel(anyskin(), anyskin_parameters(), rng)
    board = Sampler(
        skin, Environment(EnvironmentParameters(self_heating_k=0.0)), (), FaultPlan.parse(spec)
    )
    pipeline = BoardPipeline(nominal("anyskin", ""), PipelineSettings())
    cycles = []
    for k in range(300):
        now = Instant(round(k * 2e7))
        reading = board.read(now, k / 50)
        block = SampleBlock(
            0, k, now, now, 1e-3, reading.counts * skin.chips.lsb_ut, reading.temperature_c,
            reading.status,
        )  # fmt: skip
        cycles += pipeline.feed(block)
    assert code in codes(cycles)
    assert not any(c.features.valid and c.features.normal_force > 0.5 for c in cycles)
    assert cycles[-1].features.valid


@pytest.mark.parametrize(
    "spec", ["gain=fast@2s", "gain=1.5", "leap=-1@2s", "newskin@2s+1s", "loose=skin:9@1s"]
)
def test_impossible_skin_events_are_refused(spec):
    skin = SkinModel(anyskin(), anyskin_parameters(), np.random.default_rng(1))
    with pytest.raises(ValueError, match=r"allowed|taxels 0 to 4"):
        Sampler(skin, Environment(), (), FaultPlan.parse(spec))
