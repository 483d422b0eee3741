"""learned: what it remembers, its weights, and that it is quick sweep where it adds nothing."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reachd.interfaces import Goal, Twist, Wrench
from reachd.strategies import StrategyError, load_strategy
from reachd.strategies.learned import (
    RESIDUAL_BOUND,
    Policy,
    WeightsError,
    load_policy,
    save_policy,
    with_residual,
)
from reachd.strategies.memory import BOUND, FELT, LAGS, PLACED, PRESENT, RECORD, WIDTH, Memory
from reachd.strategies.parameters import parameters
from tactile_core.geometry import TIP_X, Side
from tactile_core.types import Instant, after

T0 = Instant(5_000_000_000)
GOAL = Goal(0.3, 0.05, 0.001, 20.0)


def constant(*residual: float) -> Policy:
    """A policy that always gives ``residual``."""
    matrix = np.zeros((WIDTH, 3), np.float32)
    return Policy(((matrix, np.array(residual, np.float32)),), {})


def reach(
    spec: str,
    weights: Path | None,
    make_touch: Callable[..., Any],
    make_arm: Callable[..., Any],
    name: str = "authors_sim",
    cycles: int = 400,
) -> tuple[list[Twist], list[str], list[Any]]:
    """Twists, activities and events while the finger goes half as fast as it is told to."""
    given = {} if weights is None else {"learned_weights": str(weights)}
    strategy: Any = load_strategy(spec, parameters(name, given), np.random.default_rng(3))
    strategy.start(GOAL, T0)
    now, x, y, heading = T0, -0.2, 0.02, 0.0
    twists, activities, events = [], [], []
    for k in range(cycles):
        jammed = 100 < k < 250
        touch = make_touch(
            now,
            total_force=8.0 if jammed else 0.5,
            peak_force=6.0 if jammed else 0.5,
            tip_force=0.0,
            peak_side=Side.LEFT,
            peak_x=0.1,
            peak_y=0.02,
            wrench=Wrench(-1.0, -6.0, -0.6),
        )
        twist = strategy.step(touch, make_arm(now, x=x, y=y, heading=heading), GOAL, now)
        twists.append(twist)
        activities.append(strategy.activity)
        events += strategy.take_events()
        share = 0.01 if jammed else 0.5
        x, y = x + share * twist.vx * 0.01, y + share * twist.vy * 0.01
        heading += share * twist.omega * 0.01
        now = after(now, 0.01)
    return twists, activities, events


@pytest.mark.parametrize("name", ["authors_sim", "hardware"])
def test_without_a_residual_it_is_quick_sweep(
    name: str, tmp_path: Path, make_touch: Callable[..., Any], make_arm: Callable[..., Any]
) -> None:
    save_policy(tmp_path / "zero.npz", constant(0.0, 0.0, 0.0))
    mine = reach("learned", tmp_path / "zero.npz", make_touch, make_arm, name)
    theirs = reach("quick_sweep", None, make_touch, make_arm, name)
    for a, b in zip(mine[0], theirs[0], strict=True):
        assert (a.vx, a.vy, a.omega) == pytest.approx((b.vx, b.vy, b.omega), abs=1e-15)
    assert mine[1:] == theirs[1:]
    assert any(activity.startswith("sweep") for activity in mine[1])


def test_residual_stays_on_the_sweep_it_was_learned_on(
    tmp_path: Path, make_touch: Callable[..., Any], make_arm: Callable[..., Any]
) -> None:
    base = {"authors_sim": {"sweep_angle": 0.4, "sweep_time": 0.2}}
    policy = Policy(constant(0.0, 0.0, 0.0).layers, {"base": base})
    save_policy(tmp_path / "w.npz", policy)

    def twists(name: str) -> tuple[Any, Any]:
        mine = reach("learned", tmp_path / "w.npz", make_touch, make_arm, name)
        theirs = reach("quick_sweep", None, make_touch, make_arm, name)
        return mine[:2], theirs[:2]

    mine, theirs = twists("authors_sim")
    assert mine[0] != theirs[0]
    assert mine[1].count("sweep_cw") < theirs[1].count("sweep_cw")
    mine, theirs = twists("hardware")  # of which the weights tell nothing
    assert mine[1] == theirs[1]


def test_packaged_weights_tell_of_their_sweep() -> None:
    base = load_policy().about["base"]
    assert base["authors_sim"]["sweep_angle"] == pytest.approx(math.radians(55))


def test_strong_residual_shows_in_activity_and_events(
    tmp_path: Path, make_touch: Callable[..., Any], make_arm: Callable[..., Any]
) -> None:
    save_policy(tmp_path / "left.npz", constant(0.0, 1.0, 0.5))
    twists, activities, events = reach("learned", tmp_path / "left.npz", make_touch, make_arm)
    assert "residual_ccw" in activities
    assert [e.kind for e in events if e.family == "residual"] == ["residual_start"]
    assert max(math.hypot(t.vx, t.vy) for t in twists) <= 0.05 + 1e-12
    assert max(abs(t.omega) for t in twists) <= 0.35 + 1e-12


@given(
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.tuples(*[st.floats(-RESIDUAL_BOUND, RESIDUAL_BOUND)] * 3),
    st.floats(-3, 3),
    st.sampled_from(["hardware", "authors_sim"]),
)
def test_a_residual_never_moves_the_commanded_point_too_fast(
    base: tuple[float, ...], residual: tuple[float, ...], heading: float, name: str
) -> None:
    p = parameters(name)
    twist = with_residual(
        Twist(base[0] * p.v_max, base[1] * p.v_max, base[2] * p.omega_max),
        np.array(residual),
        heading,
        p,
    )
    vx, vy = twist.vx, twist.vy
    if p.commanded_point == "tip":
        vx -= p.tip_length * twist.omega * math.sin(heading)
        vy += p.tip_length * twist.omega * math.cos(heading)
    assert math.hypot(vx, vy) <= p.v_max * (1 + 1e-9)
    assert abs(twist.omega) <= p.omega_max


def observe(memory: Memory, pose: tuple[float, float, float], touched: float = 1.0) -> Any:
    """One decision of a reach that is felt at the tip's left."""
    felt = np.zeros((1, len(FELT)))
    felt[0] = 4.0, 1.0, 3.0, 0.1, 0.02, -1.0, -2.0, -0.2, touched
    return memory.observe(
        felt,
        np.array([pose]),
        np.array([[0.1, -0.2, 0.3]]),
        np.array([[0.3, 0.05]]),
        np.array([[12.0, 0.2, 0.5, -1.0, 0.25]]),
        np.array([[0.05, 0.35]]),
    )[0]


def test_past_contacts_are_seen_from_where_the_finger_is_now() -> None:
    memory = Memory(1)
    memory.forget(np.array([0]), np.array([[0.0, 0.0, 0.0]]))
    observe(memory, (0.0, 0.0, 0.0))
    seen = observe(memory, (0.01, 0.0, math.pi / 2))
    (past, *older) = seen[RECORD + PRESENT :].reshape(len(LAGS), PLACED)
    # The finger was 1 cm behind in x; turned by 90°, that is on its left. The contact was at
    # (0.1, 0.02): 9 cm to the right, and 2 cm ahead.
    assert past[RECORD:] * 0.05 == pytest.approx(
        [0.0, 0.01, -math.pi / 2 * 0.05, 0.02, -0.09], abs=1e-6
    )
    assert not np.any(older)
    assert seen[RECORD - 3 : RECORD] == pytest.approx([0.1, -0.2, 0.3])
    tip = seen[RECORD + 6 : RECORD + 8] * 0.2
    assert tip == pytest.approx([0.01, TIP_X], abs=1e-6)


def test_what_was_not_touched_has_no_place() -> None:
    memory = Memory(1)
    memory.forget(np.array([0]), np.array([[0.0, 0.0, 0.0]]))
    observe(memory, (0.0, 0.0, 0.0), touched=0.0)
    seen = observe(memory, (0.01, 0.0, 0.0))
    assert not seen[RECORD + PRESENT + RECORD + 3 : RECORD + PRESENT + PLACED].any()


def test_reaches_side_by_side_see_what_each_would_alone() -> None:
    rng = np.random.default_rng(0)
    together, alone = Memory(2), [Memory(1), Memory(1)]
    together.forget(np.arange(2), np.zeros((2, 3)))
    for memory in alone:
        memory.forget(np.array([0]), np.zeros((1, 3)))
    for k in range(100):
        words = [rng.normal(size=(2, n)) for n in (len(FELT), 3, 3, 2, 5)]
        words.append(np.array([[0.05, 0.35]] * 2))
        both = together.observe(*words)
        for i, memory in enumerate(alone):
            assert np.array_equal(memory.observe(*[w[i : i + 1] for w in words])[0], both[i]), k
        assert np.abs(both).max() <= BOUND
        if k == 50:
            together.forget(np.array([1]), np.zeros((1, 3)))
            alone[1].forget(np.array([0]), np.zeros((1, 3)))


def test_weights_come_back_as_they_were_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    layers = tuple(
        (rng.normal(size=(a, b)).astype(np.float32), rng.normal(size=b).astype(np.float32))
        for a, b in ((WIDTH, 8), (8, 3))
    )
    save_policy(tmp_path / "w.npz", Policy(layers, {"seed": 4}))
    back = load_policy(tmp_path / "w.npz")
    seen = rng.normal(size=(5, WIDTH)).astype(np.float32)
    assert np.array_equal(back(seen), Policy(layers, {})(seen))
    assert back.about["seed"] == 4


def told(arrays: dict[str, Any], **more: Any) -> None:
    about = json.loads(bytes(arrays["about"]).decode()) | more
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda a: told(a, observation=99), "observation 99"),
        (lambda a: told(a, base={"authors_sim": {"v_max": 1.0}}), "v_max is not of a quick"),
        (lambda a: told(a, base={"authors_sim": {"sweep_time": "long"}}), "authors_sim.sweep_time"),
        (lambda a: told(a, base={"authors_sim": {"sweep_time": math.nan}}), "a finite number"),
        (lambda a: told(a, base=[0.6]), "not a table"),
        (lambda a: a.update(matrix_0=np.zeros((4, 3), np.float32)), "wrong shape"),
        (lambda a: a["offsets_0"].fill(np.nan), "not finite"),
        (lambda a: a.pop("about"), "about"),
        (lambda a: a.update(about=np.frombuffer(b"[]", np.uint8)), "how it was trained"),
        (lambda a: a.update(matrix_0=np.array([{}], object)), "pickle"),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    change: Callable[[dict[str, Any]], None], says: str, tmp_path: Path
) -> None:
    save_policy(tmp_path / "w.npz", constant(0.0, 0.0, 0.0))
    with np.load(tmp_path / "w.npz") as file:
        arrays = {name: file[name].copy() for name in file}
    change(arrays)
    np.savez(tmp_path / "w.npz", **arrays)
    with pytest.raises(WeightsError, match=says) as error:
        load_policy(tmp_path / "w.npz")
    assert "tactile train" in str(error.value)


@pytest.mark.parametrize(
    "content", [b"", b"not weights", b"PK\x03\x04 cut off", b"\x93NUMPY\x01\x00", b"{}"]
)
def test_a_file_that_is_not_weights_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "w.npz").write_bytes(content)
    given = parameters("authors_sim", {"learned_weights": str(tmp_path / "w.npz")})
    with pytest.raises(
        StrategyError, match=r"w\.npz: it is not a file of weights; .*tactile train"
    ):
        load_strategy("learned", given, np.random.default_rng(0))


def test_missing_weights_are_named(tmp_path: Path) -> None:
    given = parameters("authors_sim", {"learned_weights": str(tmp_path / "none.npz")})
    with pytest.raises(StrategyError, match=r"none\.npz"):
        load_strategy("learned", given, np.random.default_rng(0))
