"""Plan ``simdevice cupboard``: an arm in a world, and boards on its finger."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sim_device.arm.arm import ArmSettings
from sim_device.arm.cupboard import Cupboard, ScheduledFault
from sim_device.arm.server import ArmServer
from sim_device.ports_plan import BoardsRequest, Planned, plan_boards
from sim_device.world.engines import world_maker
from sim_device.world.scene_loading import load_scene
from sim_device.world.scenes import Scene, SceneError
from tactile_core.bus.session import BusConfig
from tactile_core.bus.topics import NAME


@dataclass(frozen=True, slots=True)
class CupboardRequest:
    """What the user of `simdevice cupboard` asked for; units as in its help."""

    scene: str
    seed: int
    engine: str
    arm: str
    world: str
    settings: ArmSettings
    arm_faults: tuple[ScheduledFault, ...]
    boards: BoardsRequest
    bus: BusConfig


def scene_of(request: CupboardRequest) -> Scene:
    """Scene asked for. SceneError or ValueError if it cannot be loaded or made."""
    try:
        return load_scene(request.scene, request.seed)
    except RuntimeError as error:
        raise SceneError(f"{request.scene}: {error}; take another seed") from error


def _with_seed(request: CupboardRequest, seed: int) -> Scene:
    """The same kind of scene with ``seed``. SceneError or ValueError if there is none."""
    if request.scene.endswith(".json"):
        raise SceneError(f"{request.scene} is one scene: leave the seed out to begin it again")
    return scene_of(replace(request, seed=seed))


def plan_cupboard(request: CupboardRequest) -> list[Planned]:
    """Arm and boards, all made and none open.

    ValueError (SceneError is one) if options do not fit together; `EngineMissing`, WorldError.
    """
    for name in (request.arm, request.world):
        if not NAME.fullmatch(name):
            raise ValueError(
                f"{name!r} is not a valid name; allowed: letters, digits, _ and -, at most 64"
            )
    make_world = world_maker(request.engine)
    scene = scene_of(request)
    cupboard = Cupboard(
        make_world(scene),
        request.settings,
        request.arm_faults,
        np.random.default_rng([request.boards.seed, 2]),
    )
    server = ArmServer(
        cupboard, request.arm, request.world, request.bus, partial(_with_seed, request), make_world
    )
    boards: list[Planned] = []
    if request.boards.ptys or request.boards.slcans:  # without boards the arm runs on its own
        boards = plan_boards(
            replace(request.boards, touched=cupboard.contacts, heading=cupboard.heading)
        )
    gx, gy = scene.goal
    arm = "" if request.arm == "arm" else f" --arm {request.arm}"
    connect = (
        f"reachd --strategy hybrid_event --set {scene.parameters} --target {goal_text(scene)}{arm}"
    )
    line = (
        f"{scene.source} seed {scene.seed}, {len(scene.objects)} objects, {scene.fill:.0%} full, "
        f"goal {gx:.3f} {gy:.3f} m, {request.engine}"
    )
    return [Planned(server, f"arm {request.arm}", connect, (line,), server.note), *boards]


def goal_text(scene: Scene) -> str:
    """Goal as `reachd --target` takes it, to a tenth of a millimetre."""
    x, y = scene.goal
    return f"{x:.4f},{y:.4f}"
