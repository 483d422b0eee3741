"""The primitives: closed forms, and the paper's equations in the paper's own axes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from reachd.interfaces import Goal
from reachd.strategies.builtin import Burrow, Straight
from reachd.strategies.parameters import AUTHORS_SIM, HARDWARE, parameters
from reachd.strategies.primitives import (
    Aim,
    aim,
    burrow,
    excavate,
    growth,
    slowing,
    straight,
    turn_rate,
    wrapped,
)

L = 0.158
RNG = np.random.default_rng(0)
A = 1.5 * math.pi


def goal_at(x: float, y: float) -> Goal:
    return Goal(x, y, 0.0075, 40.0)


def test_aim_is_the_direction_from_tip_to_goal(make_arm: Callable) -> None:
    found = aim(make_arm(x=0.1, y=0.05, heading=math.pi / 2), goal_at(0.4, 0.208 + 0.4), L)
    assert (found.tip_x, found.tip_y) == pytest.approx((0.1, 0.208))
    assert found.distance == pytest.approx(0.5)
    assert (found.dx, found.dy) == pytest.approx((0.6, 0.8))
    assert found.angle == pytest.approx(math.atan2(4, 3))


def test_zero_twist_at_the_goal(make_arm: Callable) -> None:
    here = aim(make_arm(x=0.2, y=0.0, heading=0.0), goal_at(0.2 + L, 0.0), L)
    assert here.distance == 0.0
    for p in (HARDWARE, AUTHORS_SIM):
        assert straight(here, 0.0, p) == straight(here, 0.0, p).__class__(0.0, 0.0, 0.0)
        assert burrow(here, 0.0, 0.3, p).vx == 0.0


def test_straight_line_follows_equations_1_and_2() -> None:
    ahead = Aim(0.0, 0.0, 0.3, 0.6, 0.8, math.atan2(0.8, 0.6))
    twist = straight(ahead, 0.0, AUTHORS_SIM)
    assert (twist.vx, twist.vy, twist.omega) == pytest.approx((0.03, 0.04, 0.35))
    # On hardware the tip is commanded: −ω ẑ × L is added to the pivot's velocity.
    twist = straight(ahead, 0.0, HARDWARE)
    assert (twist.vx, twist.vy, twist.omega) == pytest.approx((0.027, 0.036 - L * 0.1, 0.1))
    twist = straight(ahead, math.pi, HARDWARE)
    assert twist.omega == pytest.approx(-0.1)  # the shorter way round
    assert twist.vy == pytest.approx(0.036 - L * 0.1)  # −ω·L·cos π and ω both change sign


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (0.2, 1.0),
        (0.05, 1.0),
        (math.nextafter(0.05, 0), 0.25),
        (1e-9, 0.25),
        (0.0, 0.0),
        (-1e-9, -0.25),
        (-0.05, -1.0),
        (-3.0, -1.0),
        (math.pi + 0.1, -1.0),
        (-math.pi - 0.1, 1.0),
    ],
)
def test_turning_tapers_within_the_tolerance(error: float, expected: float) -> None:
    ahead = Aim(0.0, 0.0, 1.0, 1.0, 0.0, error)
    assert turn_rate(ahead, 0.0, 1.0, 0.05, 0.25) == expected


def test_angles_wrap() -> None:
    assert wrapped(3 * math.pi / 2) == pytest.approx(-math.pi / 2)
    assert wrapped(-7.0) == pytest.approx(-7.0 + 2 * math.pi)
    assert wrapped(0.3) == 0.3


@pytest.mark.parametrize(
    ("distance", "hardware", "sim_straight", "sim_burrow"),
    [(0.0, 0.5, 0.5, 1.0), (math.nextafter(0.01, 0), 0.5, 0.5, 1.0), (0.01, 1.0, 1.0, 1.0)],
)
def test_motion_slows_near_the_goal(
    distance: float, hardware: float, sim_straight: float, sim_burrow: float
) -> None:
    assert slowing(distance, HARDWARE, straight=True) == hardware
    assert slowing(distance, HARDWARE, straight=False) == hardware
    assert slowing(distance, AUTHORS_SIM, straight=True) == sim_straight
    assert slowing(distance, AUTHORS_SIM, straight=False) == sim_burrow


def test_near_the_goal_each_primitive_halves_its_speeds() -> None:
    far = Aim(0.0, 0.0, 0.02, 1.0, 0.0, 0.0)
    near = replace(far, distance=0.009)
    tip = parameters("hardware", {"commanded_point": "pivot"})
    for move in (
        lambda where, p: straight(where, -0.3, p),
        lambda where, p: burrow(where, -0.3, 0.7, p),
    ):
        one, other = move(far, tip), move(near, tip)
        assert (other.vx, other.vy) == pytest.approx((one.vx / 2, one.vy / 2))
        assert other.omega == pytest.approx(one.omega / 2)
    # The authors slow the straight line's speed only, and burrow not at all.
    one, other = straight(far, -0.3, AUTHORS_SIM), straight(near, -0.3, AUTHORS_SIM)
    assert (other.vx, other.omega) == pytest.approx((one.vx / 2, one.omega))
    assert burrow(far, -0.3, 0.7, AUTHORS_SIM) == burrow(near, -0.3, 0.7, AUTHORS_SIM)


def test_straight_golden_trajectory(fly: Callable) -> None:
    """The commanded tip moves along its line at v_max, then half; the heading turns at ω_max."""
    goal = goal_at(0.358, 0.12)
    flown = fly(Straight(HARDWARE, RNG), goal, 11.0, dt=0.001)
    start = np.array([-0.2 + L, 0.0])
    way = np.array([goal.x, goal.y]) - start
    distance, angle = float(np.hypot(*way)), math.atan2(way[1], way[0])
    t_slow = (distance - 0.01) / 0.045
    travelled = np.where(
        flown["t"] < t_slow,
        0.045 * flown["t"],
        np.minimum(distance - 0.01 + 0.0225 * (flown["t"] - t_slow), distance),
    )
    line = start + np.outer(travelled, way / distance)
    assert np.abs(flown["tip"] - line).max() < 2e-4
    turned = (angle - 0.05) / 0.1
    before = flown["t"] < turned
    assert np.abs(flown["heading"][before] - 0.1 * flown["t"][before]).max() < 1e-9
    after = (flown["t"] > turned + 0.01) & (flown["t"] < t_slow)
    creeping = np.minimum(angle - 0.05 + 0.01 * (flown["t"][after] - turned), angle)
    assert np.abs(flown["heading"][after] - creeping).max() < 1e-3


@pytest.mark.parametrize(("ratio", "fraction"), [(2.0, 0.643), (0.83 / 0.17, 0.385), (9.0, 0.253)])
def test_burrow_advances_as_measured(ratio: float, fraction: float) -> None:
    """The normalised law's mean forward fraction equals that of the authors' simulator."""
    p = parameters(
        "authors_sim", {"burrow_amplitude": ratio / (1 + ratio), "burrow_frequency": 1.0}
    )
    assert p.burrow_ratio == pytest.approx(ratio)
    ahead = Aim(0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
    twists = [burrow(ahead, 0.0, t, p) for t in np.linspace(0, 2 * math.pi, 4001)[:-1]]
    assert np.mean([t.vx for t in twists]) / p.v_max == pytest.approx(fraction, abs=6e-4)
    assert [math.hypot(t.vx, t.vy) for t in twists] == pytest.approx([0.05] * 4000)
    assert twists[1000].vy == pytest.approx(-ratio * twists[1000].vx)  # d̂ × ẑ is to the right


def test_burrow_as_printed_hardly_advances() -> None:
    p = parameters("hardware", {"burrow_law": "literal", "commanded_point": "pivot"})
    ahead = Aim(0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
    twist = burrow(ahead, 0.0, 0.5, p)  # sin(π/2) = 1
    ratio = 0.83 / 0.17
    assert twist.vx == pytest.approx(0.045 * 0.045 / math.hypot(0.045, ratio))
    assert twist.vy == pytest.approx(-0.045 * ratio / math.hypot(0.045, ratio))


@pytest.mark.parametrize("name", ["hardware", "authors_sim"])
def test_burrow_golden_trajectory(name: str, fly: Callable) -> None:
    """Equations (2) to (4), written in the paper's axes (x right, y forward) and integrated."""
    p = parameters(name)
    target_x, target_y = -0.02, 0.358  # paper axes
    tip_led = name == "hardware"

    def motion(t: float, state: np.ndarray) -> list[float]:
        px, py, theta = state.tolist()
        rx, ry = -L * math.sin(theta), L * math.cos(theta)  # pivot to tip
        ex, ey = target_x - px - rx, target_y - py - ry
        distance = math.hypot(ex, ey)
        dx, dy = ex / distance, ey / distance
        error = math.atan2(-dx, dy) - theta  # both angles from y
        omega = 0.0 if abs(error) < 0.05 else math.copysign(p.omega_max, error)
        a = p.burrow_amplitude
        sine = a / (1 - a) * math.sin(p.burrow_frequency * t)
        vx, vy = dx + dy * sine, dy - dx * sine  # d̂ × ẑ = (d_y, −d_x)
        norm = p.v_max / math.hypot(vx, vy)
        vx, vy = vx * norm, vy * norm
        if tip_led:  # less ω ẑ × r
            vx, vy = vx + omega * ry, vy - omega * rx
        return [vx, vy, omega]

    seconds = 5.0
    own = solve_ivp(motion, (0, seconds), [0.0, -0.2, 0.0], max_step=4e-3, dense_output=True)
    flown = fly(Burrow(p, RNG), goal_at(0.358, 0.02), seconds, dt=0.001)
    paper = own.sol(flown["t"])
    assert np.abs(flown["pivot"][:, 0] - paper[1]).max() < 3e-4
    assert np.abs(flown["pivot"][:, 1] + paper[0]).max() < 3e-4
    assert np.abs(flown["heading"] - paper[2]).max() < 5e-3
    assert np.ptp(flown["pivot"][:, 1]) > 0.01, "it does burrow"


def test_growth_follows_equation_6() -> None:
    assert growth(0.0, 2.0) == 0.5
    assert growth(1.0, 2.0) == 1.0
    assert growth(0.5, 4.0) == pytest.approx(2.5 / 4)
    assert growth(0.3, 1.0) == 1.0


@pytest.mark.parametrize("ccw", [True, False])
@pytest.mark.parametrize("name", ["hardware", "authors_sim"])
def test_excavation_at_a_third_matches_hand_calculation(name: str, ccw: bool) -> None:
    """t_frac = 1/3: the arc is at a quarter, K = 2/3, ω = −K ω_max sin 120°."""
    p = parameters(name)
    sign = 1.0 if ccw else -1.0
    omega = -sign * 2 / 3 * p.excavate_omega_max * math.sin(2 * math.pi / 3)
    twist = excavate(1 / 3, 0.0, p, ccw=ccw)
    assert twist.omega == pytest.approx(omega)
    assert twist.vx == pytest.approx(0.0, abs=1e-15)
    # The tip is L·ω to the left of the pivot's velocity: together K·v_max to the right for CCW.
    assert twist.vy + L * twist.omega == pytest.approx(-sign * 2 / 3 * p.v_max)
    turned = excavate(1 / 3, math.pi / 2, p, ccw=ccw)
    assert (turned.vx, turned.vy) == pytest.approx((-twist.vy, twist.vx), abs=1e-15)
    literal = excavate(1 / 3, 0.0, replace(p, excavate_law="literal"), ccw=ccw)
    assert literal.vy == pytest.approx(-sign * 2 / 3 * p.v_max * (1.0 - L * sign * omega))
    assert literal.omega == pytest.approx(omega)


@pytest.mark.parametrize("s", [1.0, 2.0, 3.5])
@pytest.mark.parametrize("ccw", [True, False])
def test_excavation_ends_where_the_integrals_say(s: float, ccw: bool) -> None:
    """∫K v (−cos, sin)(3π/2 τ) and ∫−K ω sin 2πτ in closed form, tip velocity at the heading."""
    p = parameters("authors_sim", {"spiral_growth": s})
    heading, duration = 0.4, p.excavate_duration
    sign = 1.0 if ccw else -1.0

    def tip(tau: float) -> tuple[float, float, float]:
        twist = excavate(tau, heading, p, ccw=ccw)
        c, sn = math.cos(heading), math.sin(heading)
        vx, vy = twist.vx - L * twist.omega * sn, twist.vy + L * twist.omega * c
        return c * vx + sn * vy, -(c * vy - sn * vx), twist.omega

    found = [duration * quad(lambda tau, i=i: tip(tau)[i], 0.0, 1.0)[0] for i in range(3)]
    scale = p.v_max * duration / s
    forward = scale * (1 / A + (s - 1) * (1 / A + 1 / A**2))
    right = sign * scale * (1 / A - (s - 1) / A**2)
    turn = sign * p.excavate_omega_max * duration * (s - 1) / (2 * math.pi * s)
    assert found == pytest.approx([forward, right, turn], abs=1e-9)


def test_excavation_tip_speed_grows_as_in_the_paper() -> None:
    """The tip's speed grows from v_max/s to v_max, whatever the turn rate."""
    for tau in np.linspace(0.0, 1.0, 21):
        twist = excavate(float(tau), 0.0, HARDWARE, ccw=True)
        speed = math.hypot(twist.vx, twist.vy + L * twist.omega)
        assert speed == pytest.approx(0.045 * (0.5 + 0.5 * tau))


def test_excavate_golden_trajectory_with_the_current_heading() -> None:
    """The rigid finger follows equations (5) to (8) in the paper's axes."""
    p = HARDWARE

    def motion(tau_s: float, state: np.ndarray) -> list[float]:
        tau = tau_s / 5.0
        k = (1 + tau) / 2
        theta = state[2]
        c, s = math.cos(theta), math.sin(theta)
        spiral = k * 0.045 * np.array([math.sin(A * tau), -math.cos(A * tau)])
        return [*(np.array([[c, -s], [s, c]]) @ spiral), -k * 0.1 * math.sin(2 * math.pi * tau)]

    own = solve_ivp(motion, (0, 5.0), [0.0, L, 0.0], max_step=2e-3).y[:, -1]
    x = y = heading = 0.0
    n = 20000
    for i in range(n):
        twist = excavate((i + 0.5) / n, heading, p, ccw=True)
        dt = 5.0 / n
        x, y, heading = x + twist.vx * dt, y + twist.vy * dt, heading + twist.omega * dt
    tip = (x + L * math.cos(heading), y + L * math.sin(heading))
    assert tip == pytest.approx((own[1], -own[0]), abs=1e-5)
    assert heading == pytest.approx(own[2], abs=1e-6)
    assert heading == pytest.approx(0.1 * 5 / (4 * math.pi), abs=1e-6)


FRACTIONS = st.floats(0.0, 1.0)
ANGLES = st.floats(-math.pi, math.pi)


@settings(max_examples=60, deadline=None)
@given(FRACTIONS, ANGLES, st.sampled_from(["hardware", "authors_sim"]))
def test_cw_mirrors_ccw(fraction: float, heading: float, name: str) -> None:
    """Mirrored about the finger's axis, one excavation is the other."""
    p = parameters(name)
    one = excavate(fraction, heading, p, ccw=True)
    other = excavate(fraction, heading, p, ccw=False)
    c, s = math.cos(heading), math.sin(heading)
    assert c * one.vx + s * one.vy == pytest.approx(c * other.vx + s * other.vy, abs=1e-12)
    assert c * one.vy - s * one.vx == pytest.approx(-(c * other.vy - s * other.vx), abs=1e-12)
    assert one.omega == -other.omega


@settings(max_examples=100, deadline=None)
@given(
    st.floats(-0.5, 0.4), st.floats(-0.5, 0.5), ANGLES, st.floats(0.0, 60.0), FRACTIONS, st.data()
)
def test_every_primitive_stays_within_its_limits(
    x: float, y: float, heading: float, elapsed: float, fraction: float, data: st.DataObject
) -> None:
    p = parameters(data.draw(st.sampled_from(["hardware", "authors_sim"])))
    to_x, to_y = 0.358 - x, 0.03 - y
    distance = math.hypot(to_x, to_y)
    if distance == 0.0:
        return
    where = Aim(x, y, distance, to_x / distance, to_y / distance, math.atan2(to_y, to_x))
    for twist in (
        straight(where, heading, p),
        burrow(where, heading, elapsed, p),
        excavate(fraction, heading, p, ccw=data.draw(st.booleans())),
    ):
        assert math.hypot(twist.vx, twist.vy) <= p.safety.speed + 1e-12
        assert abs(twist.omega) <= p.safety.turn_rate + 1e-12
