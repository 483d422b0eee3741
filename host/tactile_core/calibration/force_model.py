"""A fitted model of the net contact on a board, as values: plain arrays, nothing executable.

Unlike the matrices of the arrays, which are linear and know no past, it says what the contact as a
whole is, from the field of all taxels now and before: creep, hysteresis and curvature included.
`tactiled.sensing.forces` runs it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np

from tactile_core.arrays import FloatArray

TARGET_UNITS = {"normal": "N", "shear": "N", "shear_x": "N", "shear_y": "N", "x": "mm", "y": "mm"}
"""What a model may predict. ``normal``: force into the skin, positive when pressed. ``shear_x``,
``shear_y``: force on the skin along its axes; ``shear``: along the one axis of a rig that measures
no other. ``x``, ``y``: place of the contact in the frame of the rig that moved the probe."""

MAX_FEATURES = 4096
"""A readout of more inputs would not run within the 0.3 ms that a frame may cost."""
MAX_UNITS = 4096
"""Widest layer; same reason."""
MAX_DEGREE = 5
MAX_CURVED = 16
"""Components whose products are features: 16 of degree 3 make 952."""
MAX_LAYERS = 8


class NetModelError(ValueError):
    """A model whose numbers do not fit together; names the field, what it is and must be."""


@dataclass(frozen=True, slots=True, eq=False)
class RestTracker:
    """How the rest field is followed: causal, and only while the skin is at rest.

    A field within ``near_ut`` µT of the rest (norm over all channels) and within ``still_ut`` of
    its own one-second mean counts as untouched; the rest then follows it with ``tau_s`` s.
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
        """Length of the vector it takes."""
        return int(self.weights.shape[1 if self.kind == "rbf" else 0])

    @property
    def outputs(self) -> int:
        """Length of the vector it gives."""
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

    ``projection``: (3n, k), component = change of field from rest (µT, taxel axes) times this.
    ``degree``: products of the first ``curved`` components up to this many factors are features.
    ``taus_s``: (T,) s, leaky integrators of the first ``lagged`` components; the features are
    component minus integrator, alone and times powers of the first component up to ``lag_degree``.
    ``radii``: (P,) play operators (Prandtl-Ishlinskii) of the same components; features likewise.
    ``direction``: the components' unit vector is a feature.
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
        """Refuse numbers that cannot be used."""
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
        """3n."""
        return int(self.projection.shape[0])

    @property
    def components(self) -> int:
        """k."""
        return int(self.projection.shape[1])

    @property
    def size(self) -> int:
        """F, length of the feature vector."""
        history = self.lagged * (len(self.taus_s) + len(self.radii))
        products = len(monomials(self.curved, self.degree))
        unit = self.components if self.direction else 0
        return self.components + products + history * (1 + self.lag_degree) + unit


@dataclass(frozen=True, slots=True, eq=False)
class NetModel:
    """Features of the field's history, and a readout of them.

    ``mean``, ``scale``: (F,) of the features. ``layers``: readout, the last one linear to
    ``targets``. ``floor``: least value of each target, -inf for none. ``recipe``: what the fit was
    called. ``delay_s``: by how much the labels lagged behind the field; it was taken out in the
    fit and costs nothing when the model runs. ``figures``: errors, and how they were obtained.
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
        """Refuse shapes that disagree and numbers that cannot be used."""
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
        """Taxels of the board."""
        return self.features.channels // 3

    def digest(self, text: Callable[[str], None], numbers: Callable[[FloatArray], None]) -> None:
        """Give everything that the model says to ``text`` and ``numbers`` of a hash."""
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


@lru_cache(maxsize=64)  # few models are in use; asked for in every frame
def monomials(components: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Products of 2 to ``degree`` of the first ``components`` components, as their indices."""
    out: list[tuple[int, ...]] = []
    last: list[tuple[int, ...]] = [(i,) for i in range(components)]
    for _ in range(degree - 1):
        last = [(*m, i) for m in last for i in range(m[-1], components)]
        out += last
    return tuple(out)
