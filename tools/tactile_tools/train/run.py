"""A training run in a folder: batches, checkpoints, progress. It goes on where it was cut off."""

from __future__ import annotations

import gzip
import json
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from reachd.strategies.learned import RESIDUAL_BOUND, Policy, base_of, save_policy
from reachd.strategies.parameters import SETS
from sim_device.world import planar_cuda
from sim_device.world.scene_generation import generate
from sim_device.world.scenes import Scene
from tactile_tools.train.cupboards import Bank, Cupboards
from tactile_tools.train.curve import draw
from tactile_tools.train.ppo import Learner, Noise, Seen, gather
from tactile_tools.train.settings import NO_VARIETY, Settings

CHECKPOINT = "checkpoint.pt"
PROGRESS = "progress.jsonl"
CURVE = "curve.png"
WEIGHTS = "learned.npz"
SETTINGS = "settings.json"
SCENES = "scenes.jsonl.gz"
SAVE_EVERY_S = 60.0


class RunError(ValueError):
    """The folder cannot be trained in; the message names the remedy."""


@dataclass(frozen=True, slots=True)
class Judged:
    """How a policy did: share that arrived, mean s (limit where it did not), forces in N."""

    arrived: float
    seconds: float
    force_p50: float
    force_p90: float
    reaches: int


def scenes_of(names: tuple[str, ...], first: int, count: int, workers: int) -> list[Scene]:
    """``count`` scenes, in turn from each generator."""
    jobs = [(names[i % len(names)], first + i) for i in range(count)]
    if workers <= 1:
        return [_scene(job) for job in jobs]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(_scene, jobs, chunksize=16))


def _scene(job: tuple[str, int]) -> Scene:
    return generate(*job)


def read_scenes(path: Path) -> list[Scene]:
    """Scenes of a file by `write_scenes`; OSError, EOFError or ValueError if it is damaged."""
    with gzip.open(path, "rt", encoding="utf-8") as file:
        return [Scene.from_json(line) for line in file]


def write_scenes(path: Path, scenes: Iterable[Scene]) -> None:
    """Write ``scenes`` to ``path``, whole or not at all."""
    new = path.with_name(f".{path.name}.new")
    with gzip.open(new, "wt", encoding="utf-8") as file:
        file.writelines(scene.to_json() + "\n" for scene in scenes)
    new.replace(path)


def judge(act: Callable[[torch.Tensor], torch.Tensor], bank: Bank, threads: int) -> Judged:
    """One reach in each scene of ``bank``, not mirrored, felt exactly.

    ``act``: observations (n, ·) → residuals (n, 3).
    """
    n = bank.originals
    rng = np.random.default_rng(0)
    with Cupboards(
        bank, n, rng, variety=NO_VARIETY, threads=threads, rows=list(range(n))
    ) as worlds:
        seen, _ = worlds.observe()
        over, arrived = (torch.zeros(n, dtype=torch.bool, device=bank.device) for _ in range(2))
        seconds, force = (torch.zeros(n, dtype=torch.float64, device=bank.device) for _ in range(2))
        while not over.all():
            turn = worlds.step(act(seen))
            seen = turn.observations
            force = torch.where(over, force, torch.maximum(force, turn.force_n))
            now = turn.ended & ~over
            arrived |= now & turn.arrived
            seconds[now] = turn.seconds[now]
            over |= turn.ended
    forces = force.cpu().numpy()
    return Judged(
        float(arrived.double().mean()),
        float(seconds.mean()),
        float(np.median(forces)),
        float(np.percentile(forces, 90)),
        n,
    )


class Run:
    """Training in ``folder``; made anew, or going on from its checkpoint."""

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        device: str,
        threads: int,
        say: Callable[[str], None],
        start_from: Path | None = None,
    ) -> None:
        self.folder, self.settings, self._say = folder, settings, say
        self._threads = threads
        if device == "cuda" and not torch.cuda.is_available():
            raise RunError(
                "no GPU that PyTorch can use was found: leave out --device cuda, or install its "
                "driver and a build of PyTorch for it"
            )
        if device == "cuda" and not planar_cuda.available():
            raise RunError(
                "PyTorch finds the GPU, but Numba does not: pip install 'numba-cuda[cu13]' (or "
                "cu12, as the driver says), or leave out --device cuda"
            )
        folder.mkdir(parents=True, exist_ok=True)
        self._keep_settings()
        self.learner = Learner(settings.learning, device, settings.seed)
        self.batches, self.decisions, self.cpu_s, self.best = 0, 0, 0.0, -1.0
        self.started_from: str | None = None
        if start_from is not None and not (folder / CHECKPOINT).exists():
            self._adopt(start_from / CHECKPOINT)
        self._load()
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision("high")  # where a GPU has matrix units for it

    def _keep_settings(self) -> None:
        path, mine = self.folder / SETTINGS, json.loads(msgspec.json.encode(self.settings))
        if path.exists():
            theirs = json.loads(path.read_text(encoding="utf-8"))
            if theirs != mine:
                raise RunError(
                    f"{path} holds other settings; go on with those, or name a new folder"
                )
        else:
            path.write_text(json.dumps(mine, indent=2) + "\n", encoding="utf-8")

    def _load(self) -> None:
        path = self.folder / CHECKPOINT
        if not path.exists():
            return
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            self.learner.load(state["learner"])
        except Exception as error:  # of any kind: PyTorch says what is wrong by many
            raise RunError(
                f"{path} is damaged or of another version; delete it to begin anew"
            ) from error
        self.batches, self.decisions = int(state["batches"]), int(state["decisions"])
        self.cpu_s, self.best = float(state["cpu_s"]), float(state["best"])
        self.started_from = state.get("started_from")

    def _adopt(self, path: Path) -> None:
        """Begin with the networks of another run."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            self.learner.adopt(state["learner"])
        except FileNotFoundError as error:
            raise RunError(f"there is no {path}; name the folder of a run") from error
        except Exception as error:  # of any kind: PyTorch says what is wrong by many
            raise RunError(f"cannot start from {path}: {error}") from error
        self.started_from = f"{state['decisions'] / 1e6:.1f} M decisions of another run"

    def save(self) -> None:
        """Write the checkpoint in one step, so that a kill loses a minute at most."""
        new = self.folder / f".{CHECKPOINT}.new"
        torch.save(
            {
                "learner": self.learner.state(),
                "batches": self.batches,
                "decisions": self.decisions,
                "cpu_s": self.cpu_s,
                "best": self.best,
                "started_from": self.started_from,
            },
            new,
        )
        new.replace(self.folder / CHECKPOINT)

    def go(self, seconds: float) -> None:
        """Train for ``seconds`` s by the clock, once the scenes are there."""
        s = self.settings
        bank, judged = self._banks()
        # A run that goes on draws other scenes than the one that was cut off.
        rng = np.random.default_rng([s.seed, self.batches])
        generator = torch.Generator(self.learner.device)
        generator.manual_seed(int(rng.integers(2**62)))
        if self.batches == 0:
            self._judge(judged)
        saved, cpu = time.monotonic(), time.process_time()
        with Cupboards(
            bank, s.worlds, rng, variety=s.variety, reward=s.reward, threads=self._threads
        ) as worlds:
            seen, privileged = worlds.observe()
            noise = Noise(s.worlds, s.learning.lasting, s.learning.lasts, generator)
            started, over = time.monotonic(), 0
            while time.monotonic() - started < seconds:
                turns: list[Seen] = []
                began = time.monotonic()
                for _ in range(s.learning.decisions):
                    actions, chances, values = self.learner.act(seen, privileged, noise.draw())
                    turn = worlds.step(actions.clamp(-RESIDUAL_BOUND, RESIDUAL_BOUND))
                    turns.append((seen, privileged, actions, chances, values, turn))
                    seen, privileged = turn.observations, turn.privileged
                batch = gather(turns, self.learner.values(seen, privileged))
                moved = time.monotonic()
                told = self.learner.learn(batch, generator)
                told["moving_s"] = round(moved - began, 3)
                told["learning_s"] = round(time.monotonic() - moved, 3)
                self.batches += 1
                self.decisions += s.worlds * s.learning.decisions
                self.cpu_s += time.process_time() - cpu
                cpu = time.process_time()
                ended = int(batch.ended.sum())
                arrived = sum(int(t[5].arrived.sum()) for t in turns)
                told |= {"reaches": ended, "arrived": arrived / max(1, ended)}
                told["early"] = over < s.worlds  # all began at once: who arrives, ends first
                over += ended
                told["reward"] = float(batch.rewards.mean())
                self._progress(told)
                if self.batches % s.judge_every == 0:
                    self._judge(judged)
                if time.monotonic() - saved > SAVE_EVERY_S:
                    self.save()
                    saved = time.monotonic()
        self._judge(judged)
        self.save()
        draw(self.folder / PROGRESS, self.folder / CURVE)

    def _banks(self) -> tuple[Bank, Bank]:
        """Scenes to train on and to judge by; made once, then kept in the folder."""
        s, path = self.settings.scenes, self.folder / SCENES
        if path.exists():
            try:
                scenes = read_scenes(path)
            except (OSError, EOFError, ValueError) as error:
                raise RunError(f"{path} cannot be read ({error}); delete it") from error
        else:
            self._say(f"making {s.count + s.judged} scenes, once: a tenth of a CPU-second each")
            scenes = [
                *scenes_of(s.generators, s.first_seed, s.count, self._threads),
                *scenes_of(s.generators, s.judged_seed, s.judged, self._threads),
            ]
            write_scenes(path, scenes)
        device = self.learner.device.type
        return Bank(scenes[: s.count], device), Bank(scenes[s.count :], device)

    def _judge(self, bank: Bank) -> None:
        policy = self.learner.policy(self.about())
        found = judge(self.learner.mean, bank, self._threads)
        self._progress({"judged": asdict(found)})
        save_policy(self.folder / f"last-{WEIGHTS}", policy)
        # Arriving counts; a tenth of a second, or two newtons, for a thousandth of it.
        worth = found.arrived - found.seconds / 100.0 - found.force_p50 / 2000.0
        if self.best < 0 or worth > self.best:
            self.best = worth
            about = self.about() | {"judged": asdict(found)}
            save_policy(self.folder / WEIGHTS, Policy(policy.layers, about))
        self._say(
            f"batch {self.batches}: {found.arrived:.1%} of {found.reaches} arrive, mean "
            f"{found.seconds:.1f} s, peak force {found.force_p50:.1f} N (90 %: "
            f"{found.force_p90:.1f}); {self.decisions / 1e6:.1f} M decisions, "
            f"{self.cpu_s / 60:.0f} CPU-min"
        )

    def about(self) -> dict[str, Any]:
        """How these weights came about; stored with them."""
        return {
            "settings": msgspec.to_builtins(self.settings),
            "base": {name: base_of(SETS[name]) for name in self.settings.scenes.generators},
            "batches": self.batches,
            "decisions": self.decisions,
            "cpu_minutes": round(self.cpu_s / 60, 1),
            "torch": torch.__version__,
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
            "device": str(self.learner.device),
            "started_from": self.started_from,
        }

    def _progress(self, told: dict[str, Any]) -> None:
        row = {"batch": self.batches, "decisions": self.decisions, "cpu_s": round(self.cpu_s, 1)}
        with (self.folder / PROGRESS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row | told) + "\n")
            file.flush()
            os.fsync(file.fileno())
