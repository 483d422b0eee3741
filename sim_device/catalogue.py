"""The boards that can be simulated by name, the same board for the same seed every time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sim_device.controller import Identity
from sim_device.parameters import SkinParameters, anyskin_parameters
from sim_device.skin import SkinModel, nominal_calibration
from tactile_bus.calibration import BoardCalibration
from tactile_bus.geometry import SkinGeometry, anyskin, finger


@dataclass(frozen=True, slots=True)
class Model:
    """How to make a skin of one kind."""

    geometry: Callable[[], SkinGeometry]
    parameters: Callable[[], SkinParameters]


MODELS = {
    "finger": Model(finger, SkinParameters),
    "anyskin": Model(anyskin, anyskin_parameters),
}


def build_skin(model: str, seed: int) -> SkinModel:
    """Skin number ``seed`` of ``model``: its tolerances and its noise follow from the seed."""
    if model not in MODELS:
        raise ValueError(f"there is no model {model!r}; allowed: {', '.join(MODELS)}")
    kind = MODELS[model]
    return SkinModel(kind.geometry(), kind.parameters(), np.random.default_rng([seed, 0]))


def identity(model: str, seed: int) -> Identity:
    """Who that board says it is; the unique id follows from model and seed."""
    digest = hashlib.sha256(f"{model}/{seed}".encode()).digest()
    return Identity(digest[:8], model)


@lru_cache(maxsize=8)
def factory_calibration(model: str, seed: int) -> BoardCalibration:
    """Calibration that belongs to that very board, as its maker would supply it."""
    return nominal_calibration(build_skin(model, seed), identity(model, seed).unique_id.hex())
