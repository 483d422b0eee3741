"""The privileged planner: what it sees is the truth, it arrives, and no arm can run it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra `train` is not installed")

from reachd.cli import main as reachd
from reachd.strategies import StrategyError, load_strategy
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import AUTHORS_SIM, HARDWARE
from sim_device.world.engines import make_world
from sim_device.world.parameters import world_parameters
from sim_device.world.planar_worlds import Snapshot, Worlds
from sim_device.world.scene_generation import generate
from sim_device.world.scenes import Pose, Scene, SceneObject, Shape
from sim_device.world.view import WorldView
from tactile_core.types import Twist
from tactile_tools.cli import main
from tactile_tools.experiments.benchmark import PRIVILEGED
from tactile_tools.oracle.planner import GENES, Search, Settings, wanted
from tactile_tools.oracle.strategy import snapshot
from tactile_tools.reach.lockstep import Result, run_trial


def scene(*objects: SceneObject, goal: tuple[float, float] = (0.15, 0.0)) -> Scene:
    start = Pose(-0.2, 0.0, 0.0)
    return Scene("here", "authors_sim", 0, 0.375, 0.55, start, goal, objects)


def disc(x: float, y: float, mass: float = 0.5) -> SceneObject:
    return SceneObject(Shape.DISC, 0.08, 0.08, 0.07, mass, x, y, 0.0)


def reach(of: Scene, strategy: str = PRIVILEGED, engine: str = "planar") -> Result:
    return run_trial(of, strategy, AUTHORS_SIM, 3, world=make_world(engine, of))


def test_empty_cupboard_is_crossed_straight() -> None:
    result = reach(scene())
    assert result.outcome.success
    way = 0.15 + 0.2 - AUTHORS_SIM.tip_length
    assert result.outcome.time < way / AUTHORS_SIM.v_max + 0.3
    assert result.peak_load == 0.0


@pytest.mark.parametrize("engine", ["planar", "mujoco"])
def test_object_at_the_back_wall_is_put_aside(engine: str) -> None:
    """Pushed straight at the wall it would stop the finger 63 mm before the goal."""
    pytest.importorskip(engine if engine == "mujoco" else "numba")
    before = scene(disc(0.33, 0.0), goal=(0.358, 0.0))
    assert not reach(before, "straight", engine).outcome.success
    result = reach(before, engine=engine)
    assert result.outcome.success
    assert result.ejected == 0


def test_same_seed_gives_the_same_trial() -> None:
    of = scene(disc(0.05, 0.0), disc(0.14, 0.03), goal=(0.1, 0.02))
    assert reach(of) == reach(of)


@pytest.mark.parametrize("engine", ["mujoco", "planar", "pymunk"])
def test_copies_are_in_the_world_s_own_state(engine: str) -> None:
    if engine != "planar":
        pytest.importorskip(engine)
    of = generate("authors_sim", 11)
    world = make_world(engine, of)
    for _ in range(250):
        world.step(0.01, Twist(0.05, 0.0, 0.1))
    speeds = np.zeros((len(of.objects), 3))
    state = snapshot(WorldView(world), speeds)
    with Worlds([of] * 3, world.parameters, threads=1) as copies:
        copies.step(0.5, np.tile((0.05, 0.0, 0.0), (3, 1)))
        copies.place(state)
        finger = world.finger()
        for index in range(3):
            np.testing.assert_allclose(copies.poses()[index], world.poses(), rtol=0, atol=1e-9)
            np.testing.assert_allclose(
                copies.finger[index],
                [finger.x, finger.y, finger.heading, finger.twist.vx, finger.twist.vy,
                 finger.twist.omega],
                rtol=0, atol=1e-9,
            )  # fmt: skip
            assert (copies.on_shelf()[index] == world.on_shelf()).all()
        assert copies.ejected.tolist() == [world.ejected] * 3
        assert copies.time.tolist() == [0.0] * 3


def test_a_placed_world_goes_on_as_its_original_whatever_it_did_before() -> None:
    of = generate("authors_sim", 11)
    original = make_world("planar", of)
    state = snapshot(WorldView(original), np.zeros((len(of.objects), 3)))
    ends = []
    with Worlds([of] * 2, threads=1) as copies:
        for before in ((0.05, 0.02, 0.0), (0.05, -0.04, 0.2)):
            copies.step(2.0, np.tile(before, (2, 1)))
            copies.place(state)
            copies.step(2.0, np.tile((0.05, 0.0, 0.05), (2, 1)))
            ends.append(copies.poses())
    assert ends[0].tolist() == ends[1].tolist()
    original.step(2.0, Twist(0.05, 0.0, 0.05))
    np.testing.assert_allclose(ends[0][1, :, :2], original.poses()[:, :2], rtol=0, atol=1e-3)


def test_a_state_of_another_scene_is_refused() -> None:
    of = scene(disc(0.1, 0.0))
    state = snapshot(WorldView(make_world("planar", of)), np.zeros((1, 3)))
    with (
        Worlds([scene(), scene()], threads=1) as worlds,
        pytest.raises(ValueError, match="a state of 1 objects"),
    ):
        worlds.place(state)


@pytest.mark.parametrize("of_set", [AUTHORS_SIM, HARDWARE], ids=lambda p: p.name)
def test_no_plan_asks_for_more_than_the_set_allows(of_set: Parameters) -> None:
    rng = np.random.default_rng(1)
    of = replace(scene(disc(0.1, 0.0)), parameters=of_set.name)
    search = Search(
        of, world_parameters(of_set.name), of_set, rng, Settings(candidates=12, horizon_s=0.2)
    )
    state = Snapshot(
        np.array([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0]), np.zeros(3), np.array([[0.1, 0.0, 0.0]]),
        np.zeros((1, 3)), np.ones(1, np.bool_),
    )  # fmt: skip
    plans = np.stack([search.plan(state, None)[0], *rng.uniform(-1, 1, (30, GENES)).tolist()])
    for at_s in (0.0, 0.3, 0.7, 2.5):
        finger = np.tile(state.finger, (len(plans), 1))
        vx, vy, omega = wanted(plans, at_s, finger, of.goal, 0.01, of_set).T
        assert np.abs(omega).max() <= of_set.omega_max + 1e-12
        lever = of_set.tip_length * omega if of_set.commanded_point == "tip" else 0.0
        assert np.hypot(vx, vy + lever).max() <= of_set.v_max + 1e-12


def test_no_arm_can_run_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(StrategyError, match="privileged"):
        load_strategy(PRIVILEGED, HARDWARE, np.random.default_rng(0))
    assert reachd(["--strategy", PRIVILEGED, "--target", "0.3,0"]) == 2
    told = capsys.readouterr().err
    assert "is privileged" in told
    assert "Traceback" not in told
    assert len(told.strip().splitlines()) == 1


def test_what_it_is_given_cannot_change_the_world() -> None:
    world = make_world("planar", scene(disc(0.1, 0.0)))
    view = WorldView(world)
    view.poses()[:] = math.nan
    view.on_shelf()[:] = False
    assert world.poses().tolist() == [[0.1, 0.0, 0.0]]
    assert world.on_shelf().tolist() == [True]
    assert not hasattr(view, "step")


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    try:
        code = main(["experiment", *map(str, words)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    return code, told.out, told.err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--set", "authors_sim"), "squeezed"),
        (("--set", "recorded"), "squeezed"),
        (("--engine", "paper"), "mujoco"),
        (("--scenes", "0"), "--scenes"),
        (("--param", "v_maxx=1"), "v_maxx"),
        (("--depth", "taxels"), "--depth"),
    ],
)
def test_bad_arguments_are_named(
    words: tuple[str, ...],
    says: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, error = run(capsys, "oracle", *words)
    assert code == 2
    assert says in error


def test_study_writes_rows_that_can_be_run_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("--set", "hardware", "--scenes", 2, "--param", "time_limit=1", "--jobs", 1)
    code, out, _ = run(capsys, "oracle", *words)
    assert code == 0
    line = next(each for each in out.splitlines() if each.startswith("hardware"))
    assert "0 % [0, 66]" in line
    code, out, _ = run(capsys, "oracle", *words)
    assert "resuming: 2 of 2" in out
    code, out, _ = run(capsys, "trial", "--row", "runs/oracle:1")
    assert code == 0
    assert "the same as its row, bit for bit" in out
    code, _, error = run(capsys, "report", "runs/oracle")
    assert code == 2
    assert "has no report" in error


def test_benchmark_wants_it_named_for_what_it_is(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ("benchmark", PRIVILEGED, "--name", "best of all", "--out", str(tmp_path / "run"))
    try:
        code = main([*words, "--sets", "hardware"])
    except SystemExit as stop:
        code = int(stop.code or 0)
    assert code == 2
    assert "must contain 'privileged'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
