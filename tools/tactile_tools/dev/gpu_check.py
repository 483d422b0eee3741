"""Whether the GPU gives what the processor gives, and how fast: ``python -m …dev.gpu_check``.

For a machine with a CUDA device; its figures are in docs/figures.md. Needs the extra ``learn``.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reachd.strategies.parameters import parameters
from sim_device.world.planar_worlds import Device, Worlds
from sim_device.world.scene_generation import generate
from sim_device.world.scenes import Scene
from tactile_tools.train.cupboards import Bank, Cupboards
from tactile_tools.train.kernels import CYCLE_S, CYCLES
from tactile_tools.train.run import judge
from tactile_tools.train.settings import NO_VARIETY

FIRST_SEED = 730_000
"""Scenes that nothing is judged by."""

CYCLES_COMPARED = 300


def straight(worlds: Worlds, scenes: list[Scene], cycles: int) -> np.ndarray[Any, Any]:
    """Every finger goes straight for its goal; (cycles, n, 3) poses, features read each cycle."""
    v_max = parameters(scenes[0].parameters).v_max
    goal = np.array([scene.goal for scene in scenes])
    poses = np.zeros((cycles, len(scenes), 3))
    for k in range(cycles):
        finger = worlds.finger
        poses[k] = finger[:, :3]
        away = goal - finger[:, :2] - (0.158, 0.0)
        length = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
        twists = np.zeros((len(scenes), 3))
        twists[:, :2] = away * (v_max / np.maximum(length, v_max))[:, np.newaxis]
        worlds.step(CYCLE_S, twists)
    return poses


def alike(scenes: list[Scene]) -> dict[str, Any]:
    """How far the poses on both devices part, and whether the GPU repeats itself to the bit."""

    def run(device: Device) -> np.ndarray[Any, Any]:
        with Worlds(scenes, device=device) as worlds:
            poses = straight(worlds, scenes, CYCLES_COMPARED)
            features, _ = worlds.features()
        return np.concatenate([poses.reshape(-1), features.reshape(-1)])

    cpu, first, again = run("cpu"), run("cuda"), run("cuda")
    size = CYCLES_COMPARED * len(scenes) * 3
    away = np.abs(cpu - first)[:size].reshape(CYCLES_COMPARED, len(scenes), 3).max(axis=2)
    return {
        "repeats_to_the_bit": bool(np.array_equal(first, again)),
        "poses_same_bits": float((away == 0).mean()),
        "away_after_1_s_median_m": float(np.median(away[99])),
        "away_after_3_s_median_m": float(np.median(away[-1])),
        "away_after_3_s_p90_m": float(np.percentile(away[-1], 90)),
    }


def outcomes(scenes: list[Scene], threads: int) -> dict[str, Any]:
    """Whole reaches of quick_sweep, physics and touch and all, on both devices."""

    def still(seen: torch.Tensor) -> torch.Tensor:
        return torch.zeros((len(seen), 3), device=seen.device)

    found: dict[str, Any] = {}
    for device in ("cpu", "cuda"):
        bank = Bank(scenes, device)
        began = time.perf_counter()
        judged = judge(still, bank, threads)
        found[device] = {"arrived": judged.arrived, "mean_s": judged.seconds}
        found[device]["took_s"] = time.perf_counter() - began
    return found


def speed(bank: Bank, n: int, decisions: int = 60) -> dict[str, float]:
    """Simulated s a s of ``n`` reaches of quick_sweep that begin anew: kernels alone, and with
    observations, rewards and new beginnings, from the twentieth decision on."""
    worlds = Cupboards(bank, n, np.random.default_rng(0), variety=NO_VARIETY)
    actions = torch.zeros((n, 3), device=bank.device)
    whole = kernels = 0.0
    with worlds:
        for k in range(decisions):
            torch.cuda.synchronize()
            began = time.perf_counter()
            worlds.step(actions)
            torch.cuda.synchronize()
            whole += (time.perf_counter() - began) * (k >= 20)
        for _ in range(5):
            began = time.perf_counter()
            worlds.run()
            torch.cuda.synchronize()
            kernels += time.perf_counter() - began
    span = CYCLES * CYCLE_S * n
    return {
        "threads": worlds.launcher.threads,
        "kernels": span * 5 / kernels,
        "whole": span * (decisions - 20) / whole,
    }


def main() -> None:
    """Check, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="file for the figures")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 4096, 16384, 32768])
    parser.add_argument("--scenes", type=int, default=64)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    found: dict[str, Any] = {
        "gpu": torch.cuda.get_device_name(0),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }

    def tell(name: str, value: Any) -> None:
        found[name] = value
        print(name, json.dumps(value), flush=True)
        if options.out:
            options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")

    scenes = [generate("authors_sim", FIRST_SEED + k) for k in range(options.scenes)]
    tell("alike", alike(scenes))
    tell("outcomes", outcomes(scenes, options.threads))
    bank = Bank(scenes, "cuda")
    for n in options.worlds:
        tell(f"reaches_{n}", speed(bank, n))
    for n in options.worlds:
        many = [scenes[k % len(scenes)] for k in range(n)]
        with Worlds(many, device="cuda") as worlds:
            worlds.step(CYCLE_S, np.zeros((n, 3)))
            began = time.perf_counter()
            straight(worlds, many, 200)
            tell(f"worlds_{n}", 200 * CYCLE_S * n / (time.perf_counter() - began))


if __name__ == "__main__":
    main()
