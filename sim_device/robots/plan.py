"""Build a robot, its world and its boards from the options of `simdevice ur` and the like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from armd.config import ArmConfig, load_config, plane_of
from sim_device.ports_plan import BoardsRequest, Planned, plan_boards
from sim_device.robots import ur, xarm
from sim_device.robots.plant import Mount, Plant
from sim_device.robots.robot_server import Emulated, RobotServer, TruthFile, WorldOnBus
from sim_device.robots.sockets import Network, Servers
from sim_device.world.base import World
from sim_device.world.engines import world_maker
from sim_device.world.scene_loading import load_scene
from sim_device.world.scenes import SceneError
from tactile_core.bus.session import BusConfig
from tactile_core.geometry import TIP_X

KINDS: Final = ("ur", "xarm")


@dataclass(frozen=True, slots=True)
class RobotRequest:
    """What was asked for; units as in the help. ``scene``: None for free air."""

    kind: str
    config: Path
    address: str
    scene: str | None
    seed: int
    engine: str
    world: str
    latency: float
    loss: float
    stop_force: float
    truth: Path | None
    control: bool
    boards: BoardsRequest
    bus: BusConfig | None


def plan_robot(request: RobotRequest) -> list[Planned]:
    """Robot and boards, all made and nothing open; ConfigError, ValueError, WorldError."""
    config = load_config(request.config)
    plane = plane_of(config, str(request.config))
    world: World | None = None
    start = (-TIP_X, 0.0, 0.0)
    goal = ""
    if request.scene is not None:
        try:
            scene = load_scene(request.scene, request.seed)
        except RuntimeError as error:
            raise SceneError(f"{request.scene}: {error}; take another seed") from error
        world = world_maker(request.engine)(scene)
        start = (scene.start.x, scene.start.y, scene.start.heading)
        goal = f" --set {scene.parameters} --target {scene.goal[0]:.4f},{scene.goal[1]:.4f}"
    plant = Plant(Mount(plane.cupboard, plane.pivot), start, world, config.robot.acceleration)
    truth = TruthFile(request.truth)
    robot, ports = _controller(request, config, plant, truth)
    servers = Servers(
        request.address,
        ports,
        Network(request.latency, request.loss),
        np.random.default_rng([request.seed, 3]),
    )
    on_bus = None
    if world is not None and request.bus is not None:
        on_bus = WorldOnBus(world, request.world, request.bus)
    server = RobotServer(robot, servers, truth, on_bus, control=request.control)
    boards: list[Planned] = []
    if request.boards.ptys or request.boards.slcans:
        boards = plan_boards(replace(request.boards, touched=plant.contacts, heading=plant.yaw))
    where = "in free air" if world is None else f"in {request.scene} {request.seed}{goal}"
    line = f"emulated robot at {request.address}, {where}"
    connect = f"armd --driver {request.kind} --config {request.config}"
    return [Planned(server, request.kind, connect, (line,)), *boards]


def _controller(
    request: RobotRequest, config: ArmConfig, plant: Plant, truth: TruthFile
) -> tuple[Emulated, dict[int, Callable[[], Any]]]:
    tool = config.tool
    if request.kind == "ur":
        setup = ur.Setup(
            payload=tool.payload,
            tool=(*tool.position, *tool.rotation),
            stop_force=request.stop_force,
        )
        robot = ur.EmulatedUr(plant, setup, truth.truth)
        return robot, ur.ports(robot)
    arm = xarm.EmulatedXarm(plant, xarm.Setup.of(tool, request.stop_force), truth.truth)
    return arm, xarm.ports(arm, config.robot.port)
