"""Fitted model of the whole contact on a board: plain arrays, nothing executable.

The matrices of the arrays are linear and have no memory. This model predicts the contact as a whole
from the present and past field of all taxels, including creep, hysteresis and curvature.
`tactiled.sensing.forces` evaluates it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np

from tactile_core.arrays import FloatArray

TARGET_UNITS = {"normal": "N", "shear": "N", "shear_x": "N", "shear_y": "N", "x": "mm", "y": "mm"}
"""Possible targets of a model. ``normal``: force into the skin, positive when pressed. ``shear_x``,
``shear_y``: force on the skin along its axes; ``shear``: along the only axis that the rig measures.
``x``, ``y``: place of the contact in the frame of the rig that moved the probe."""

MAX_FEATURES = 4096
"""Most features. A readout of more would not run within the 0.3 ms that a frame may take."""
MAX_UNITS = 4096
"""Widest layer, for the same reason."""
MAX_DEGREE = 5
MAX_CURVED = 16
"""Most components whose products are features: 16 of degree 3 make 952."""
MAX_LAYERS = 8


class NetModelError(ValueError):
    """Inconsistent numbers of a model; the text names the field, its value and what is allowed."""


@dataclass(frozen=True, slots=True, eq=False)
class RestTracker:
    """Tracking of the rest field: causal, and only while the skin is at rest.

    A field within ``near_ut`` µT of the rest field (norm over all channels) and within ``still_ut``
    µT of its own one-second mean counts as untouched; the rest field then follows it with time
    constant ``tau_s``.
    """

    near_ut: float
    still_ut: float
    tau_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One layer of a readout. ``weights``: (in, out), or (units, in) centres for ``rbf``.

    ``linear``: v W + b. ``tanh``: tanh(v W + b). ``rbf``: exp(-gamma |v - centre|²) for each
    centre; ``bias`` is then (1,), gamma.
    """

    kind: Literal["linear", "tanh", "rbf"]
    weights: FloatArray
    bias: FloatArray

    @property
    def inputs(self) -> int:
        """Length of the input vector."""
        return int(self.weights.shape[1 if self.kind == "rbf" else 0])

    @property
    def outputs(self) -> int:
        """Length of the output vector."""
        return int(self.weights.shape[0 if self.kind == "rbf" else 1])


@dataclass(frozen=True, slots=True)
class Figure:
    """One error figure and how it was obtained."""

    name: str
    value: float
    unit: str
    how: str


@dataclass(frozen=True, slots=True, eq=False)
class FeatureMap:
    """Features of the field and its history. n taxels, k components, F features.

    ``projection``: (3n, k); components = change of field from rest (µT, taxel axes) times this.
    ``degree``: products of the first ``curved`` components, up to this many factors, are features.
    ``taus_s``: (T,) s, leaky integrators of the first ``lagged`` components; features are component
    minus integrator, alone and times powers of the first component up to ``lag_degree``. ``radii``:
    (P,) play operators (Prandtl-Ishlinskii) of the same components, with features of the same form.
    ``direction``: the unit vector of the components is a feature.
    """

    tracker: RestTracker | None
    projection: FloatArray
    degree: int = 1
    curved: int = 0
    taus_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    lagged: int = 0
    lag_degree: int = 0
    radii: FloatArray = field(default_factory=lambda: np.zeros(0))
    direction: bool = False

    def __post_init__(self) -> None:
        """Reject unusable numbers."""
        if self.projection.ndim != 2 or self.projection.shape[0] % 3:
            raise NetModelError(f"projection has {len(self.projection)} rows, not 3 a taxel")
        k = self.components
        _finite(("projection", self.projection), ("taus_s", self.taus_s), ("radii", self.radii))
        for name, given, low, high in (
            ("number of components", k, 1, MAX_FEATURES),
            ("degree", self.degree, 1, MAX_DEGREE),
            ("curved", self.curved, 0, min(k, MAX_CURVED)),
            ("lagged", self.lagged, 0, k),
            ("lag_degree", self.lag_degree, 0, 3),
        ):
            if not low <= given <= high:
                raise NetModelError(f"{name} is {given}; allowed: {low} to {high}")
        if (self.taus_s <= 0).any() or (self.radii <= 0).any():
            raise NetModelError("taus_s and radii must be above 0")
        if self.size > MAX_FEATURES:
            raise NetModelError(f"{self.size} features; allowed: at most {MAX_FEATURES}")
        tracker = self.tracker
        if tracker is not None and not (
            0 < tracker.near_ut < np.inf
            and 0 < tracker.still_ut < np.inf
            and 0 < tracker.tau_s < np.inf
        ):
            raise NetModelError("rest: near_ut, still_ut and tau_s must be finite and above 0")

    @property
    def channels(self) -> int:
        """Number of channels, 3n."""
        return int(self.projection.shape[0])

    @property
    def components(self) -> int:
        """Number of components, k."""
        return int(self.projection.shape[1])

    @property
    def size(self) -> int:
        """Length of the feature vector, F."""
        history = self.lagged * (len(self.taus_s) + len(self.radii))
        products = len(monomials(self.curved, self.degree))
        unit = self.components if self.direction else 0
        return self.components + products + history * (1 + self.lag_degree) + unit


@dataclass(frozen=True, slots=True, eq=False)
class NetModel:
    """Features of the field's history and a readout of them.

    ``mean``, ``scale``: (F,) of the features. ``layers``: readout; the last one is linear to
    ``targets``. ``floor``: least value of each target, -inf for none. ``recipe``: name of the fit.
    ``delay_s``: delay of the labels behind the field; the fit removed it, so it adds none at run
    time. ``figures``: errors and how they were obtained.
    """

    recipe: str
    targets: tuple[str, ...]
    features: FeatureMap
    mean: FloatArray
    scale: FloatArray
    layers: tuple[Layer, ...]
    floor: FloatArray
    delay_s: float
    figures: tuple[Figure, ...]

    def __post_init__(self) -> None:
        """Reject inconsistent shapes and unusable numbers."""
        _finite(
            ("mean", self.mean),
            ("scale", self.scale),
            ("delay_s", np.array(self.delay_s)),
            *((f"layer[{i}].weights", layer.weights) for i, layer in enumerate(self.layers)),
            *((f"layer[{i}].bias", layer.bias) for i, layer in enumerate(self.layers)),
        )
        for target in self.targets:
            if target not in TARGET_UNITS:
                raise NetModelError(f"target {target!r}; allowed: {', '.join(TARGET_UNITS)}")
        if not self.targets or len(set(self.targets)) != len(self.targets):
            raise NetModelError(f"targets {self.targets}: at least one, and each only once")
        width = self.features.size
        for name, value in (("mean", self.mean), ("scale", self.scale)):
            if value.shape != (width,):
                raise NetModelError(f"{name} has {value.size} numbers, not {width}")
        if (self.scale <= 0).any():
            raise NetModelError("scale must be above 0")
        if not 1 <= len(self.layers) <= MAX_LAYERS:
            raise NetModelError(f"{len(self.layers)} layers; allowed: 1 to {MAX_LAYERS}")
        for i, layer in enumerate(self.layers):
            if layer.inputs != width:
                raise NetModelError(f"layer[{i}] takes {layer.inputs} numbers, not {width}")
            if layer.bias.shape != ((1,) if layer.kind == "rbf" else (layer.outputs,)):
                raise NetModelError(f"layer[{i}].bias has {layer.bias.size} numbers")
            width = layer.outputs
            if width > MAX_UNITS:
                raise NetModelError(f"layer[{i}] gives {width} numbers, at most {MAX_UNITS}")
        if self.layers[-1].kind != "linear" or width != len(self.targets):
            raise NetModelError(f"the last layer must be linear, to {len(self.targets)} targets")
        if self.floor.shape != (len(self.targets),) or np.isnan(self.floor).any():
            raise NetModelError(f"floor must have {len(self.targets)} numbers")

    @property
    def taxels(self) -> int:
        """Number of taxels of the board."""
        return self.features.channels // 3

    def digest(self, text: Callable[[str], None], numbers: Callable[[FloatArray], None]) -> None:
        """Pass the whole model to ``text`` and ``numbers``, which feed a hash."""
        f = self.features
        text(f"{self.recipe}/{','.join(self.targets)}/{f.degree}/{f.curved}/{f.lagged}")
        text(f"{f.lag_degree}/{f.direction}/{f.tracker is not None}")
        if f.tracker is not None:
            numbers(np.array([f.tracker.near_ut, f.tracker.still_ut, f.tracker.tau_s]))
        for value in (f.projection, f.taus_s, f.radii, self.mean, self.scale, self.floor):
            text(str(value.shape))
            numbers(value)
        for layer in self.layers:
            text(f"{layer.kind}{layer.weights.shape}")
            numbers(layer.weights)
            numbers(layer.bias)
        numbers(np.array([self.delay_s, *(figure.value for figure in self.figures)]))
        for figure in self.figures:
            text(f"{figure.name}/{figure.unit}/{figure.how}")


def _finite(*named: tuple[str, FloatArray]) -> None:
    for name, value in named:
        if not np.isfinite(value).all():
            raise NetModelError(f"{name} is not finite")


@lru_cache(maxsize=64)  # called in every frame, with few models in use
def monomials(components: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Products of 2 to ``degree`` of the first ``components`` components, as tuples of indices."""
    out: list[tuple[int, ...]] = []
    last: list[tuple[int, ...]] = [(i,) for i in range(components)]
    for _ in range(degree - 1):
        last = [(*m, i) for m in last for i in range(m[-1], components)]
        out += last
    return tuple(out)
