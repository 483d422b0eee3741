"""The ``[[net]]`` tables of a calibration file: fitted models of the contact as a whole."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from tactile_core.calibration.force_model import (
    MAX_DEGREE,
    MAX_FEATURES,
    MAX_LAYERS,
    MAX_UNITS,
    TARGET_UNITS,
    FeatureMap,
    Figure,
    Layer,
    NetModel,
    NetModelError,
    RestTracker,
)
from tactile_core.calibration.table import Table, matrix_lines, number, numbers, quoted

Float = NDArray[np.float64]

KINDS = ("linear", "tanh", "rbf")
MAX_CHANNELS = 3 * 128 * 4
"""Channels of the largest board: four arrays of 128 taxels."""
MAX_TERMS = 64
"""Time constants or radii; more would not run in time."""
MAX_FIGURES = 100


def net_lines(net: NetModel) -> Iterable[str]:
    """Lines of one model."""
    f = net.features
    yield "[[net]]"
    yield f"recipe = {quoted(net.recipe)}"
    yield f"targets = [{', '.join(quoted(t) for t in net.targets)}]"
    units = ", ".join(quoted(TARGET_UNITS[t]) for t in net.targets)
    yield f"units = [{units}]"
    least = ", ".join("-inf" if math.isinf(v) else number(v) for v in net.floor.tolist())
    yield f"floor = [{least}]  # least value of each target"
    yield f"delay_s = {number(net.delay_s)}  # of the labels behind the field, taken out in the fit"
    if f.tracker is not None:
        tracker = f.tracker
        yield (
            f"rest = {{near_ut = {number(tracker.near_ut)}, still_ut = {number(tracker.still_ut)}, "
            f"tau_s = {number(tracker.tau_s)}}}"
        )
    yield f"components = {f.projection.shape[1]}"
    yield from matrix_lines("projection", f.projection, "x, y, z of each taxel in turn, 1/uT")
    yield f"degree = {f.degree}"
    yield f"curved = {f.curved}"
    yield f"taus_s = [{numbers(f.taus_s)}]"
    yield f"radii = [{numbers(f.radii)}]"
    yield f"lagged = {f.lagged}"
    yield f"lag_degree = {f.lag_degree}"
    yield f"direction = {'true' if f.direction else 'false'}"
    yield f"mean = [{numbers(net.mean)}]"
    yield f"scale = [{numbers(net.scale)}]"
    for layer in net.layers:
        yield "[[net.layer]]"
        yield f"kind = {quoted(layer.kind)}"
        yield f"columns = {layer.weights.shape[1]}"
        yield from matrix_lines("weights", layer.weights, "centres" if layer.kind == "rbf" else "")
        yield f"bias = [{numbers(layer.bias)}]"
    for figure in net.figures:
        yield "[[net.figure]]"
        yield f"name = {quoted(figure.name)}"
        yield f"value = {number(figure.value)}"
        yield f"unit = {quoted(figure.unit)}"
        yield f"how = {quoted(figure.how)}"


def read_net(table: Table) -> NetModel:
    """One model; `CalibrationError` names file, key, what was given and what is allowed."""
    recipe = table.text("recipe")
    targets = _texts(table, "targets")
    units = _texts(table, "units")
    for target, unit in zip(targets, units, strict=False):
        if TARGET_UNITS.get(target, unit) != unit:
            raise table.wrong("units", unit, f"{TARGET_UNITS[target]} for {target}")
    floor = _floor(table)
    delay = table.number("delay_s")
    tracker = None
    if table.has("rest"):
        rest = table.table("rest")
        tracker = RestTracker(rest.number("near_ut"), rest.number("still_ut"), rest.number("tau_s"))
        rest.done()
    components = table.integer("components", 1, MAX_CHANNELS)
    projection = table.rows("projection", components, MAX_CHANNELS)
    degree, curved = table.integer("degree", 1, MAX_DEGREE), table.integer("curved", 0, components)
    taus, radii = table.numbers("taus_s", MAX_TERMS), table.numbers("radii", MAX_TERMS)
    lagged = table.integer("lagged", 0, components)
    lag_degree = table.integer("lag_degree", 0, 3)
    direction = table.boolean("direction")
    mean, scale = table.numbers("mean", MAX_FEATURES), table.numbers("scale", MAX_FEATURES)
    layers = tuple(_layer(each) for each in table.tables("layer", MAX_LAYERS))
    figures: tuple[Figure, ...] = ()
    if table.has("figure"):
        figures = tuple(_figure(each) for each in table.tables("figure", MAX_FIGURES))
    table.done()
    try:
        features = FeatureMap(
            tracker, projection, degree, curved, taus, lagged, lag_degree, radii, direction
        )
        return NetModel(recipe, targets, features, mean, scale, layers, floor, delay, figures)
    except NetModelError as error:
        raise table.unfit(str(error)) from error


def _texts(table: Table, key: str) -> tuple[str, ...]:
    value = table.take(key)
    if not isinstance(value, list) or not value or not all(isinstance(t, str) for t in value):
        raise table.wrong(key, value, "a list of texts")
    return tuple(value)


def _floor(table: Table) -> Float:
    """Numbers of which some may be -inf."""
    value = table.take("floor")
    if (
        not isinstance(value, list)
        or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        or any(math.isnan(v) or v == math.inf for v in value)
    ):
        raise table.wrong("floor", value, "finite numbers or -inf")
    return np.array(value, float)


def _layer(table: Table) -> Layer:
    kind = table.text("kind")
    if kind not in KINDS:
        raise table.wrong("kind", kind, "one of " + ", ".join(KINDS))
    columns = table.integer("columns", 1, MAX_FEATURES)
    weights = table.rows("weights", columns, MAX_FEATURES)
    bias = table.numbers("bias", MAX_UNITS)
    table.done()
    return Layer(cast(Literal["linear", "tanh", "rbf"], kind), weights, bias)


def _figure(table: Table) -> Figure:
    out = Figure(table.text("name"), table.number("value"), table.text("unit"), table.text("how"))
    table.done()
    return out
