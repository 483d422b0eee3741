"""Reach in one process on virtual time: the daemons' own objects, faster than real time.

World → (contacts or board bytes → decoder → pipeline) → strategy → safety gate → arm → world. A
trial is a function of scene, strategy, parameters, seed and depth; nothing reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from reachd.control import Controller, Inputs
from reachd.control import Cycle as ControlCycle
from reachd.gate.gate import SafetyGate
from reachd.interfaces import ArmState, Touch
from reachd.services import make_goal
from reachd.strategies import load_strategy
from reachd.strategies.parameter_fields import Parameters
from reachd.trial import Outcome, State, Supervisor
from sim_device.arm.arm import ArmSettings, SimulatedArm
from sim_device.world.base import World
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scenes import Scene
from sim_device.world.view import WorldView
from tactile_core.types import ArmLimits, Instant, Twist, after, record
from tactile_tools.reach.touch_senses import ContactSense, Sense, TaxelSense
from tactiled.blocks import Cycle

Depth = Literal["contacts", "taxels"]

BEGIN = Instant(1_000_000_000)
"""Virtual time at which every trial begins; not 0, so that an instant never set is noticed."""


@record
class Step:
    """One control cycle of a trial, for logs and drawings."""

    now: Instant
    world: World
    touch: Touch | None
    cycle: Cycle | None
    arm: ArmState
    control: ControlCycle


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a trial.

    ``mean_load``, ``peak_load``: summed normal forces in N. ``entered``: the tip came within
    7.5 mm of the goal. ``ejected``: objects past the front edge. ``simulated_s``: virtual time.
    """

    outcome: Outcome
    entered: bool
    ejected: int
    mean_load: float
    peak_load: float
    cycles: int
    simulated_s: float


class LockstepArm(Protocol):
    """What a trial asks of an arm; see `sim_device.arm.arm.SimulatedArm`."""

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Ask for ``limits``; returns those in force."""
        ...

    def command(self, twist: Twist, now: Instant, expiry: float) -> bool:
        """Move at ``twist`` until ``expiry`` s from ``now``, or the next command."""
        ...

    def advance(self, now: Instant) -> list[ArmState]:
        """Simulate up to ``now`` and return the states that came, in order."""
        ...


ENTERED_M = 0.0075
"""Radius of the paper's goal region, m."""


def run_trial(
    scene: Scene,
    strategy: str,
    parameters: Parameters,
    seed: int,
    *,
    depth: Depth = "contacts",
    world: World | None = None,
    sense: Sense | None = None,
    watch: Callable[[Step], None] | None = None,
    make_arm: Callable[[World, Instant], LockstepArm] | None = None,
) -> Result:
    """Run one trial to its end. StrategyError, ConfigError or WorldError if it cannot be run.

    ``seed``: strategy, board and arm draw from generators made from it. ``world``: None for
    MuJoCo's. ``sense``: None for that of ``depth``. ``watch``: called once per control cycle.
    ``make_arm``: makes another arm than the simulated one, of a world and its first instant.
    """
    world = MujocoWorld(scene) if world is None else world
    if sense is None:
        sense = ContactSense() if depth == "contacts" else TaxelSense(seed)
    view = WorldView(world)
    planner = load_strategy(strategy, parameters, np.random.default_rng([seed, 1]), lambda: view)
    now = sense.settle(world, BEGIN)
    arm: LockstepArm
    if make_arm is None:
        arm = SimulatedArm(world, ArmSettings(), now, np.random.default_rng([seed, 2]))
    else:
        arm = make_arm(world, now)
    arm.request_limits(parameters.safety.arm_limits)
    gate = SafetyGate(parameters.safety)
    supervisor = Supervisor(planner, parameters)
    period = parameters.safety.period
    controller = Controller(supervisor, gate, parameters.safety)
    now, state = _next(arm, now, period)
    touch = sense.feel(world, now)
    refused = gate.arm(now, touch, state, now)
    if refused:
        raise RuntimeError("the gate refuses to arm: " + "; ".join(i.text for i in refused))
    refusal = controller.reach(make_goal(*scene.goal, parameters), now)
    if refusal is not None:
        raise RuntimeError("the trial could not begin: " + refusal)
    loads: list[float] = []
    cycles = 0
    while supervisor.state in (State.HOMING, State.REACHING):
        control = controller.cycle(Inputs(touch, state), now, 0.0)
        arm.command(control.decision.twist, now, control.decision.expiry)
        if watch is not None:
            watch(Step(now, world, touch, sense.cycle, state, control))
        now, state = _next(arm, now, period)
        touch = sense.feel(world, now)
        loads.append(sum([c.normal_force for c in world.contacts()]))
        cycles += 1
    outcome = supervisor.outcome
    if outcome is None:
        raise RuntimeError("the trial ended without an outcome: " + supervisor.status(now).text)
    return Result(
        outcome=outcome,
        entered=outcome.closest <= ENTERED_M,
        ejected=world.ejected,
        mean_load=math.fsum(loads) / max(1, cycles),
        peak_load=max(loads, default=0.0),
        cycles=cycles,
        simulated_s=cycles * period,
    )


def _next(arm: LockstepArm, now: Instant, period: float) -> tuple[Instant, ArmState]:
    """Advance one control period. Returns the instant and the newest state of an arm without
    faults."""
    now = after(now, period)
    return now, arm.advance(now)[-1]
