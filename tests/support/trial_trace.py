"""Digest of everything in a trial. Also a program, run in a process of its own."""

from __future__ import annotations

import hashlib
import json
import struct
import sys
from dataclasses import asdict, replace
from typing import Any

from reachd.strategies.parameters import parameters
from sim_device.world.scene_generation import generate
from sim_device.world.scenes import Scene
from tactile_tools.reach.lockstep import Result, Step, run_trial

SECONDS = 3.0
"""Length of a trial in s: enough for contacts with several objects."""


def crowded(objects: int = 12) -> Scene:
    """A scene crowded at the front edge, reduced for speed, with its target near the front."""
    scene = generate("authors_sim", 29)
    near = sorted(scene.objects, key=lambda o: abs(o.y) + o.x)[:objects]
    return replace(scene, objects=tuple(near), goal=(0.16, 0.0))


def traced(
    scene: Scene,
    strategy: str,
    seed: int,
    depth: Any,
    watched: bool = True,
    seconds: float = SECONDS,
) -> tuple[Result, str]:
    """Run a trial of at most ``seconds``; returns its result and a digest of all its numbers."""
    digest = hashlib.sha256()

    def watch(step: Step) -> None:
        arm, twist = step.arm, step.control.decision.twist
        numbers = [arm.x, arm.y, arm.heading, arm.fx, arm.fy, arm.mz]
        numbers += [twist.vx, twist.vy, twist.omega]
        if step.touch is not None:
            touch = step.touch
            numbers += [touch.peak_force, touch.total_force, touch.tip_force, touch.peak_x]
            digest.update(struct.pack("<qq", touch.captured, touch.received))
        digest.update(struct.pack(f"<q{len(numbers)}d", step.now, *numbers))
        digest.update(step.world.poses().tobytes())
        digest.update(step.control.status.activity.encode())

    limited = replace(parameters(scene.parameters), time_limit=seconds)
    result = run_trial(
        scene, strategy, limited, seed, depth=depth, watch=watch if watched else None
    )
    digest.update(json.dumps(asdict(result), default=str, sort_keys=True).encode())
    return result, digest.hexdigest()


if __name__ == "__main__":
    strategy, seed, depth = sys.argv[1:]
    print(traced(crowded(), strategy, int(seed), depth)[1])
