"""Scene, world, parameters and touch of a trial, as its conditions change them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from reachd.strategies.parameter_fields import Parameters
from sim_device.world.base import World
from sim_device.world.engines import make_world
from sim_device.world.parameters import Friction, WorldParameters, world_parameters
from sim_device.world.scene_generation import GENERATORS, generate
from sim_device.world.scene_loading import load_scene
from sim_device.world.scenes import Scene
from tactile_core.config import ConfigError
from tactile_tools.experiments.degraded_touch import DegradedContacts, DegradedTaxels
from tactile_tools.experiments.spec import Conditions, TrialSpec
from tactile_tools.reach.touch_senses import Sense

CACHED_SCENES = 8
"""Scenes kept by a worker: trials come scene by scene, and a worker with several threads may have
a few scenes in progress at once."""

MISSED_FEATURES = 3
"""Periods of the feature stream that the safety gate waits before it stops the arm. Without this,
features at 5 Hz would be judged by a limit on their age that was set for 15 Hz."""


@lru_cache(maxsize=CACHED_SCENES)
def build_scene(source: str, seed: int, objects: tuple[int, int] | None) -> Scene:
    """Scene of a generator or file; ValueError, RuntimeError or OSError if it cannot be had."""
    if objects is None:
        return load_scene(source, seed)
    if source not in GENERATORS:
        raise ConfigError(
            f"the number of objects cannot be set in {source}; it can in "
            f"{', '.join(sorted(GENERATORS))}"
        )
    return generate(source, seed, objects)


def scene_of(spec: TrialSpec) -> Scene:
    """Scene of ``spec``; errors as in `build_scene`."""
    return build_scene(spec.source, spec.scene_seed, spec.changed.objects)


def world_of(spec: TrialSpec, scene: Scene) -> World:
    """World of ``spec``; ConfigError, or ValueError if the engine is not installed."""
    figures = world_parameters(scene.parameters)
    changed = _figures(figures, spec.changed)
    return make_world(spec.engine, scene, changed)


def _figures(figures: WorldParameters, conditions: Conditions) -> WorldParameters:
    """``figures`` with the friction and the finger of ``conditions``."""
    friction = figures.friction
    if (each := conditions.friction_all) is not None:
        friction = Friction(each, each, each, each, each)
    if (mu := conditions.friction_objects) is not None:
        # The engines use the greater of two surfaces' coefficients, so no pair can have less.
        friction = replace(
            friction,
            objects=mu,
            object_wall=max(mu, friction.object_wall),
            finger_object=max(mu, friction.finger_object),
        )
    width = conditions.finger_width
    return replace(
        figures,
        friction=friction,
        finger_width=figures.finger_width if width is None else width,
    )


def parameters_of(spec: TrialSpec) -> Parameters:
    """Parameters of ``spec``; ConfigError."""
    resolved = spec.resolved()
    rate = spec.changed.feature_rate
    if rate is None:
        return resolved
    safety = resolved.safety
    age = max(safety.features_age, MISSED_FEATURES / rate)
    return replace(
        resolved,
        safety=replace(safety, features_age=age, features_latch=max(safety.features_latch, age)),
    )


def sense_of(spec: TrialSpec, scene: Scene) -> Sense | None:
    """Sense of touch of ``spec``; None for the plain one of its depth."""
    conditions = spec.changed
    if conditions == replace(
        conditions, noise=0.0, feature_rate=None, dead_taxels=0.0, finger_width=None
    ):
        return None
    figures = world_parameters(scene.parameters)
    stretch = _figures(figures, conditions).finger_width / figures.finger_width
    kind = DegradedContacts if spec.typed_depth == "contacts" else DegradedTaxels
    return kind(
        spec.trial_seed,
        noise=conditions.noise,
        rate=conditions.feature_rate,
        dead=conditions.dead_taxels,
        stretch=stretch,
    )
