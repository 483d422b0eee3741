"""Train the residual of `learned` without one part of its recipe after another, and compare.

``python -m tactile_tools.dev.learned_ablation`` writes ``docs/results/learned_ablation.json``:
short trainings from nothing, alike but for what each leaves out, each judged on the same scenes.
Chance in training moves the outcome as well, so each is trained with several seeds. What is
already in the file is not run again, so a run that was stopped goes on.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import torch

from reachd.strategies.learned import RESIDUAL_BOUND, load_policy
from reachd.strategies.memory import FELT, LAGS, PLACED, PRESENT, RECORD, WIDTH
from sim_device.world.scenes import Scene
from tactile_tools.train.cupboards import Bank, Cupboards
from tactile_tools.train.kernels import AGENT
from tactile_tools.train.ppo import Learner, Noise, Seen, gather
from tactile_tools.train.run import judge, read_scenes, scenes_of, write_scenes
from tactile_tools.train.settings import Learning, Reward, Variety

FIRST_SEED: Final = 1_000_000
TRAINED_ON: Final = 1500

JUDGED_SEED: Final = 740_000
"""Scenes that are neither trained on, nor chosen by, nor judged on by the benchmark."""

JUDGED: Final = 1000
REACHES: Final = 1024
SET: Final = "authors_sim"
PAST: Final = RECORD + PRESENT
"""First column of an observation that is memory."""


def _blind(*columns: range) -> tuple[int, ...]:
    return tuple([k for part in columns for k in part])


def _lags(least: int) -> tuple[int, ...]:
    """Columns of what was ``least`` decisions ago or longer."""
    return _blind(*(range(PAST + k * PLACED, PAST + (k + 1) * PLACED)
                    for k, lag in enumerate(LAGS) if lag >= least))  # fmt: skip


def _touch() -> tuple[int, ...]:
    """Columns of what the skin felt, now and before, and of where the contact was."""
    then = [PAST + k * PLACED for k in range(len(LAGS))]
    return _blind(
        range(len(FELT)),
        *(range(at, at + len(FELT)) for at in then),
        *(range(at + RECORD + 3, at + PLACED) for at in then),
    )


class Variant(msgspec.Struct, frozen=True, kw_only=True):
    """A recipe. ``blind``: columns of the observation that are always 0. ``critic``: whether the
    critic sees the objects. ``swept``: whether quick sweep's own sweeps are beneath the residual.
    """

    learning: Learning = Learning()
    variety: Variety = Variety()
    reward: Reward = Reward()
    blind: tuple[int, ...] = ()
    critic: bool = True
    swept: bool = True


VARIANTS: Final = {
    "the recipe": Variant(),
    "no memory": Variant(blind=_lags(0)),
    "no touch": Variant(blind=_touch()),
    "critic sees no objects": Variant(critic=False),
    "noise anew each decision": Variant(learning=Learning(lasting=0.0)),
    "no sweep beneath": Variant(swept=False),
    "force costs nothing": Variant(reward=Reward(force=0.0)),
    "force costs four times as much": Variant(reward=Reward(force=0.016)),
    "memory of 0.8 s": Variant(blind=_lags(9)),
    "layers of 64 and 32": Variant(learning=Learning(hidden=(64, 32))),
    "no mirrored scenes": Variant(variety=Variety(mirrored=0.0)),
}


def bank_of(scenes: list[Scene], *, swept: bool) -> Bank:
    """``scenes`` with the quick sweep that the weights of the package were trained on."""
    bank = Bank(scenes)
    for name, value in load_policy().about["base"][SET].items():
        if name in (AGENT.names or ()):
            bank.agents[name] = value
    if not swept:
        bank.agents["jam_force"] = np.inf  # no force is one of a jam
    return bank


def trained(
    variant: Variant, seed: int, scenes: list[Scene], decisions: int, threads: int
) -> Learner:
    """A learner that took ``decisions`` decisions with ``variant``, from nothing."""
    s = variant.learning
    learner = Learner(s, "cpu", seed)
    generator = torch.Generator()
    generator.manual_seed(seed)
    sees = _sight(variant)
    share = 1.0 if variant.critic else 0.0
    rng = np.random.default_rng(seed)
    with Cupboards(
        bank_of(scenes, swept=variant.swept),
        REACHES,
        rng,
        variety=variant.variety,
        reward=variant.reward,
        threads=threads,
    ) as worlds:
        noise = Noise(REACHES, s.lasting, s.lasts, generator)
        seen, privileged = worlds.observe()
        seen, privileged = seen * sees, privileged * share
        for _ in range(decisions // (REACHES * s.decisions)):
            turns: list[Seen] = []
            for _ in range(s.decisions):
                actions, chances, values = learner.act(seen, privileged, noise.draw())
                turn = worlds.step(actions.clamp(-RESIDUAL_BOUND, RESIDUAL_BOUND))
                turns.append((seen, privileged, actions, chances, values, turn))
                seen, privileged = turn.observations * sees, turn.privileged * share
            learner.learn(gather(turns, learner.values(seen, privileged)), generator)
    return learner


def _sight(variant: Variant) -> torch.Tensor:
    """What an observation is multiplied by: 0 where the variant is blind."""
    sees = torch.ones(WIDTH)
    sees[list(variant.blind)] = 0.0
    return sees


def row_of(
    variant: Variant,
    seed: int,
    scenes: list[Scene],
    judged: list[Scene],
    decisions: int,
    threads: int,
) -> dict[str, Any]:
    """What is written down of a training."""
    began = time.process_time()
    learner = trained(variant, seed, scenes, decisions, threads)
    sees = _sight(variant)
    found = judge(
        lambda seen: learner.mean(seen * sees), bank_of(judged, swept=variant.swept), threads
    )
    return {
        "decisions": decisions,
        "seed": seed,
        **asdict(found),
        "cpu_s": round(time.process_time() - began),
    }


def scenes_from(folder: Path, first: int, count: int, workers: int) -> list[Scene]:
    """``count`` scenes from seed ``first`` on, made once and then kept in ``folder``."""
    path = folder / f"{first}.jsonl.gz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_scenes(path, scenes_of((SET,), first, count, workers))
    return read_scenes(path)


def main() -> None:
    """Run the variants that are missing, and write each as it is there."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--json", type=Path, default=Path("docs/results/learned_ablation.json"))
    parser.add_argument("--folder", type=Path, default=Path("runs/ablation"), help="scenes' place")
    parser.add_argument("--decisions", type=int, default=1_500_000, help="of each training")
    parser.add_argument("--seeds", type=int, default=2, help="trainings of each variant")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("variants", nargs="*", metavar="VARIANT", help="default: all")
    given = parser.parse_args()
    unknown = set(given.variants) - VARIANTS.keys()
    if unknown:
        parser.error(f"no variant {min(unknown)!r}; there are: {', '.join(VARIANTS)}")
    torch.set_num_threads(given.threads)
    scenes = scenes_from(given.folder, FIRST_SEED, TRAINED_ON, given.threads)
    judged = scenes_from(given.folder, JUDGED_SEED, JUDGED, given.threads)
    rows: dict[str, Any] = json.loads(given.json.read_text()) if given.json.exists() else {}
    for seed in range(1, given.seeds + 1):
        for name in given.variants or VARIANTS:
            done = rows.setdefault(name, [])
            if any((row["seed"], row["decisions"]) == (seed, given.decisions) for row in done):
                continue
            row = row_of(VARIANTS[name], seed, scenes, judged, given.decisions, given.threads)
            done.append(row)
            given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            print(name, msgspec.json.encode(row).decode(), flush=True)


if __name__ == "__main__":
    main()
