"""Physics engines by name."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, cast, get_args

from tactile_core.cli import EXTRAS, MissingExtraError, require

if TYPE_CHECKING:
    from sim_device.world.base import World
    from sim_device.world.parameters import WorldParameters
    from sim_device.world.scenes import Scene

Engine = Literal["mujoco", "planar", "pymunk", "pybullet"]

ENGINES: Final[tuple[Engine, ...]] = get_args(Engine)
"""Names of the engines; published figures come from the first."""

_CLASSES: Final[dict[str, str]] = {
    "mujoco": "MujocoWorld",
    "planar": "PlanarWorld",
    "pymunk": "PymunkWorld",
    "pybullet": "PybulletWorld",
}
_LIBRARIES: Final[dict[str, str]] = {"planar": "numba"}
"""Library that an engine needs, where that is not called as the engine is."""

EngineMissing = MissingExtraError
"""The requested engine is not installed; the message says how to install it."""


class WorldMaker(Protocol):
    """Builds a world. ``parameters``: None for those that the scene names."""

    def __call__(self, scene: Scene, parameters: WorldParameters | None = None) -> World:
        """World of ``scene``; WorldError if the engine fails."""
        ...


def world_maker(engine: str) -> WorldMaker:
    """Builder of worlds in ``engine``; `EngineMissing`, or ValueError for an unknown name."""
    if engine not in _CLASSES:
        raise ValueError(f"unknown engine {engine!r}; available: {', '.join(ENGINES)}")
    library = _LIBRARIES.get(engine, engine)
    require(library, extra=EXTRAS[library], what=f"engine {engine!r}")
    module: Any = import_module(f"sim_device.world.{engine}_world")
    return cast("WorldMaker", getattr(module, _CLASSES[engine]))


def make_world(engine: str, scene: Scene, parameters: WorldParameters | None = None) -> World:
    """World of ``scene`` in ``engine``; see `world_maker`."""
    return world_maker(engine)(scene, parameters)
