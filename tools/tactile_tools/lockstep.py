"""A reach in one process on virtual time: the daemons' own objects, faster than real time.

World → (contacts or board bytes → decoder → pipeline) → strategy → safety gate → arm → world. A
trial is a function of scene, strategy, parameters, seed and depth; nothing reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from reachd.goals import make_goal
from reachd.outcome import Outcome
from reachd.parameter_fields import Parameters
from reachd.safety import Decision, Intervention, SafetyGate
from reachd.seam import ArmState, Touch
from reachd.strategies import load_strategy
from reachd.supervisor import Command, State, Status, Supervisor
from sim_device.world.arm import ArmSettings, SimulatedArm
from sim_device.world.base import World
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scenes import Scene
from tactile_bus.instant import Instant, after
from tactile_bus.records import record
from tactile_tools.touch_senses import ContactSense, Sense, TaxelSense
from tactiled.blocks import Cycle

Depth = Literal["contacts", "taxels"]

PERIOD = 0.01
"""s of a control cycle, as in reachd."""

BEGIN = Instant(1_000_000_000)
"""Virtual time at which every trial begins; not 0, so that what was never set shows."""


@record
class Step:
    """One control cycle of a trial, for whoever logs or draws it."""

    now: Instant
    world: World
    touch: Touch | None
    cycle: Cycle | None
    arm: ArmState
    command: Command
    decision: Decision
    status: Status
    new: tuple[Intervention, ...]


@dataclass(frozen=True, slots=True)
class Result:
    """What became of a trial. ``distance``: m at the end. ``mean_load``: N, mean of summed normal
    forces. ``entered``: the tip was ever within 7.5 mm. ``ejected``: objects past the front edge.
    """

    outcome: Outcome
    entered: bool
    ejected: int
    mean_load: float
    peak_load: float
    cycles: int


ENTERED = 0.0075
"""m, the paper's goal region."""


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
) -> Result:
    """Run one trial to its end. StrategyError, SettingError or WorldError where it cannot be run.

    ``seed``: strategy, board and arm draw from generators made of it. ``world``: another engine
    than MuJoCo. ``watch``: called once a control cycle.
    """
    world = MujocoWorld(scene) if world is None else world
    if sense is None:
        sense = ContactSense() if depth == "contacts" else TaxelSense(seed)
    planner = load_strategy(strategy, parameters, np.random.default_rng([seed, 1]))
    now = sense.settle(world, BEGIN)
    arm = SimulatedArm(world, ArmSettings(), now, np.random.default_rng([seed, 2]))
    arm.request_limits(parameters.safety.arm_limits)
    gate = SafetyGate(parameters.safety)
    supervisor = Supervisor(planner, parameters)
    goal = make_goal(*scene.goal, parameters)
    now, state = _next(arm, now)
    touch = sense.feel(world, now)
    refused = gate.arm(now, touch, state, now)
    if refused:
        raise RuntimeError("the gate refuses to arm: " + "; ".join(i.text for i in refused))
    supervisor.request_goal(goal, now)
    loads: list[float] = []
    cycles = 0
    while supervisor.state in (State.HOMING, State.REACHING):
        command = supervisor.step(touch, state, now)
        decision = gate.step(
            command.wanted, touch, state, command.goal, now, failure=command.failure
        )
        new = supervisor.observe(decision, now)
        arm.command(decision.twist, now, decision.expiry)
        if watch is not None:
            status = supervisor.status(now)
            watch(Step(now, world, touch, sense.cycle, state, command, decision, status, new))
        now, state = _next(arm, now)
        touch = sense.feel(world, now)
        loads.append(sum([c.normal_force for c in world.contacts()]))
        cycles += 1
    outcome = supervisor.outcome
    if outcome is None:
        raise RuntimeError("the trial ended without an outcome: " + supervisor.status(now).text)
    return Result(
        outcome=outcome,
        entered=outcome.closest <= ENTERED,
        ejected=world.ejected,
        mean_load=math.fsum(loads) / max(1, cycles),
        peak_load=max(loads, default=0.0),
        cycles=cycles,
    )


def _next(arm: SimulatedArm, now: Instant) -> tuple[Instant, ArmState]:
    """One control period on; the newest state of an arm that has no faults."""
    now = after(now, PERIOD)
    return now, arm.advance(now)[-1]
