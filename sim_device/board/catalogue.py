"""Boards that can be simulated, by name. The same seed always gives the same board."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sim_device.board.firmware import Identity
from sim_device.skin.parameters import SkinParameters, anyskin_parameters
from sim_device.skin.skin import SkinModel, nominal_calibration
from tactile_core.calibration import BoardCalibration
from tactile_core.calibration.nominal import nominal as nominal_calibration_of
from tactile_core.geometry import (
    ANYSKIN_CHIPS,
    MOUNTS,
    SkinGeometry,
    anyskin,
    anyskin_jaws,
    finger,
)


@dataclass(frozen=True, slots=True)
class Model:
    """Geometry and parameters from which a skin is made."""

    geometry: Callable[[], SkinGeometry]
    parameters: Callable[[], SkinParameters]


MODELS = {
    "finger": Model(finger, SkinParameters),
    "anyskin": Model(anyskin, anyskin_parameters),
}


def build_skin(model: str, seed: int, arrays: tuple[int, ...] | None = None) -> SkinModel:
    """Skin number ``seed`` of ``model``: its tolerances and its noise follow from the seed.

    ``arrays``: magnetometers of each board of an ``anyskin`` controller, None for one board of
    five; ValueError for another model, and for more than 20.
    """
    if model not in MODELS:
        raise ValueError(f"there is no model {model!r}; allowed: {', '.join(MODELS)}")
    kind = MODELS[model]
    geometry = kind.geometry() if arrays is None else controller(model, arrays)
    return SkinModel(geometry, kind.parameters(), np.random.default_rng([seed, 0]))


def controller(model: str, arrays: tuple[int, ...]) -> SkinGeometry:
    """Geometry of AnySkin boards on one controller. Boards of five sit on different sides of the
    finger."""
    if model != "anyskin":
        raise ValueError(
            f"the arrays of a {model} are fixed; they can be set only for anyskin boards"
        )
    if set(arrays) == {ANYSKIN_CHIPS} and len(arrays) <= len(MOUNTS):
        return anyskin_jaws(len(arrays))
    geometry = nominal_calibration_of("anyskin", "", None, arrays).geometry
    return replace(geometry, arrays=tuple(replace(a, posed=True) for a in geometry.arrays))


def identity(model: str, seed: int) -> Identity:
    """Identity that the board reports; the unique id follows from model and seed."""
    digest = hashlib.sha256(f"{model}/{seed}".encode()).digest()
    return Identity(digest[:8], model)


@lru_cache(maxsize=8)
def factory_calibration(
    model: str, seed: int, arrays: tuple[int, ...] | None = None
) -> BoardCalibration:
    """Calibration of exactly that board, as its maker would supply it."""
    skin = build_skin(model, seed, arrays)
    return nominal_calibration(skin, identity(model, seed).unique_id.hex())
