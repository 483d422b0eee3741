"""What a training run is told: the defaults, or a TOML file of these keys."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from tactile_core.config import Count, Fraction, Newtons, Positive, allowed_values

JUDGING_SEEDS: Final = range(700_000, 710_000)
"""Seeds of the benchmark's scenes, on which nothing may be trained or chosen."""


class Learning(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[learning]``: proximal policy optimisation (Schulman et al. 2017)."""

    hidden: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=4096)], ...],
        Meta(min_length=1, max_length=6, description="width of each hidden layer"),
    ] = (256, 128)
    decisions: Annotated[
        int, Meta(ge=2, le=1024, description="decisions of each reach in a batch")
    ] = 24
    epochs: Annotated[int, Meta(ge=1, le=50, description="times that a batch is learned from")] = 2
    minibatches: Annotated[
        int, Meta(ge=1, le=256, description="steps of the optimiser in an epoch")
    ] = 6
    discount: Annotated[Fraction, Meta(description="γ, worth of the next decision's reward")] = (
        0.995
    )
    trace: Annotated[Fraction, Meta(description="λ of generalised advantages")] = 0.95
    clip: Annotated[
        Positive, Meta(le=1, description="greatest change of a chance that is rewarded")
    ] = 0.2
    clip_norm: Annotated[Positive, Meta(description="greatest norm of a gradient")] = 0.5
    rate: Annotated[Positive, Meta(le=0.1, description="learning rate at the start")] = 5e-4
    greatest_rate: Annotated[Positive, Meta(le=0.1, description="greatest learning rate")] = 1e-3
    drift: Annotated[
        Positive, Meta(description="divergence of an epoch that the rate is adapted to")
    ] = 0.012
    spread: Annotated[
        Positive, Meta(le=1, description="standard deviation of residuals at the start")
    ] = 0.35
    least_spread: Annotated[Positive, Meta(le=1, description="least of it")] = 0.08
    entropy: Annotated[float, Meta(ge=0, le=1, description="worth of the spread's entropy")] = 0.001
    lasting: Annotated[
        Fraction,
        Meta(description="share of the variance of residuals' noise that lasts for `lasts`"),
    ] = 0.5
    lasts: Annotated[
        Positive,
        Meta(
            description="time constant of that share, s; what is drawn ten times a second cancels"
        ),
    ] = 0.5


class Scenes(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[scenes]``: what is trained on, and what the best weights are chosen by. Never the scenes
    of the benchmark, seeds 700000 to 709999."""

    generators: Annotated[
        tuple[Literal["authors_sim", "hardware"], ...],
        Meta(min_length=1, max_length=8, description="sets, taken in turn"),
    ] = ("authors_sim",)
    first_seed: Annotated[
        int, Meta(ge=1_000_000, le=1_000_000_000, description="seed of the first scene")
    ] = 1_000_000
    count: Annotated[Count, Meta(le=100_000, description="scenes; each is used mirrored, too")] = (
        1500
    )
    judged_seed: Annotated[
        int,
        Meta(ge=710_000, le=999_999, description="seed of the first scene to choose weights by"),
    ] = 720_000
    judged: Annotated[Count, Meta(le=10_000, description="how many of those")] = 200


class Variety(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[variety]``: how much cupboards and touch differ from what the scenes name."""

    friction: Annotated[
        float, Meta(ge=0, le=2, description="every friction is multiplied by e to ± this")
    ] = 0.3
    mass: Annotated[
        float, Meta(ge=0, le=2, description="every mass is multiplied by e to ± this")
    ] = 0.3
    taxels: Annotated[
        Fraction,
        Meta(description="share of reaches felt as through taxels: 25 Hz, 30 to 60 ms late"),
    ] = 0.5
    gain: Annotated[Fraction, Meta(description="greatest relative error of forces")] = 0.15
    noise: Annotated[
        Newtons, Meta(ge=0, le=5, description="greatest noise of forces felt through taxels")
    ] = 0.15
    bias: Annotated[Newtons, Meta(ge=0, le=5, description="greatest offset of the sum of them")] = (
        0.1
    )
    lost: Annotated[
        Fraction, Meta(description="greatest share of samples of taxels that do not come")
    ] = 0.05
    again: Annotated[
        Fraction, Meta(description="share of failed scenes that are tried again at once")
    ] = 0.4
    mirrored: Annotated[Fraction, Meta(description="share of mirrored scenes")] = 0.5


NO_VARIETY: Final = Variety(
    friction=0, mass=0, taxels=0, gain=0, noise=0, bias=0, lost=0, again=0, mirrored=0
)
"""The scenes as they are, felt exactly: for judging."""


class Reward(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[reward]``: what a decision is worth."""

    progress: Annotated[float, Meta(description="a metre nearer to the goal")] = 10.0
    arrival: Annotated[
        float, Meta(description="arriving, and as much again times the part of the time left")
    ] = 3.0
    decision: Annotated[float, Meta(ge=0, description="taken off every decision")] = 0.005
    force: Annotated[
        float, Meta(ge=0, description="taken off for each N of the sum of forces above `free`")
    ] = 0.004
    free: Annotated[Newtons, Meta(ge=0, description="force that costs nothing")] = 10.0
    ejected: Annotated[
        float, Meta(ge=0, description="taken off for an object pushed out of the cupboard")
    ] = 0.3
    action: Annotated[float, Meta(ge=0, description="taken off for the square of a residual")] = (
        0.002
    )


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys before the first table."""

    seed: Annotated[int, Meta(ge=0, le=2**62, description="seed of everything drawn")] = 0
    worlds: Annotated[
        Count,
        Meta(le=200_000, description="reaches side by side"),
        allowed_values("a whole number from 1 to 200000"),
    ] = 1024
    judge_every: Annotated[Count, Meta(description="batches between two judgements")] = 60
    learning: Learning = Learning()
    scenes: Scenes = Scenes()
    variety: Variety = Variety()
    reward: Reward = Reward()
