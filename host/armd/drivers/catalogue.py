"""Drivers by name. The vendor's library of each is imported only when the driver is used."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final, cast

from tactile_core.cli import MissingExtraError

if TYPE_CHECKING:
    from armd.config import ArmConfig
    from armd.driver import Driver

DRIVERS: Final[dict[str, tuple[str, str, str]]] = {
    "mock": ("mock", "MockDriver", ""),
    "ur": ("ur", "UrDriver", "rtde_control"),
    "franka": ("franka", "FrankaDriver", "franky"),
    "xarm": ("xarm", "XarmDriver", "xarm"),
    "flexiv": ("flexiv", "FlexivDriver", "flexivrdk"),
}
"""Name: module, class, and the vendor's module that it needs."""

REMEDY: Final[dict[str, str]] = {
    "ur": "pip install 'tactile-reach[ur]' (x86-64, Python 3.10 to 3.12)",
    "franka": "pip install 'tactile-reach[franka]' (x86-64)",
    "xarm": "pip install 'tactile-reach[xarm]'",
    "flexiv": "pip install 'tactile-reach[flexiv]' under Python 3.12",
}


def missing(name: str) -> str | None:
    """Why the driver called ``name`` cannot be used here; None if it can."""
    library = DRIVERS[name][2]
    if not library or find_spec(library) is not None:
        return None
    return f"{library}, the vendor's library for {name}, is not installed: {REMEDY[name]}"


def make_driver(name: str, config: ArmConfig) -> Driver:
    """The driver called ``name``; `MissingExtraError` where its library is not installed, and
    `SetupError` where nothing says where its robot is."""
    problem = missing(name)
    if problem is not None:
        raise MissingExtraError(problem)
    module, kind, library = DRIVERS[name]
    from armd.driver import SetupError  # with numpy, which `armd --help` need not wait for

    if library and not config.robot.address:
        raise SetupError(
            "[robot] address is missing: write the host name or IP of the robot there, for a "
            "Flexiv its serial number"
        )
    found: Any = getattr(import_module(f"armd.drivers.{module}"), kind)
    return cast("Driver", found(config))
