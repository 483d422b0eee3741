"""A process that only logs, to be killed: ``python -m tactile_tools.dev.crash_writer``.

It notes in a shared file what it gave to the recorder, so that whoever kills it can compare.
"""

from __future__ import annotations

import argparse
import mmap
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.topics import FEATURES, FORCES, GEOMETRY, RAW, Topic
from tactile_core.log.recorder import Recorder, RecorderSettings
from tactile_core.types import WallClock, monotonic_now

TRUTH = struct.Struct("<QQQ")
"""Messages recorded so far, wall-clock ns of the first and of the last."""

NAME = "b0"
RATE_HZ = 100.0
"""Rate of each of the three streams, Hz: a board at its usual rate."""

SPLIT_BYTES = 150_000
"""A file lasts about a second, so that many kills fall into the change of files."""

TAXELS = 80


def run(directory: Path, truth: Path, seed: int, seconds: float) -> None:
    """Log to ``directory`` for ``seconds``, noting what was recorded in the file ``truth``."""
    rng = np.random.default_rng(seed)
    with truth.open("r+b") as file:
        shared = mmap.mmap(file.fileno(), TRUTH.size)
    clock = WallClock.take()
    settings = RecorderSettings(split_bytes=SPLIT_BYTES, min_free_bytes=0)
    recorder = Recorder(directory, settings, clock=clock)
    recorder.attach("calibration.toml", "application/toml", b"# nominal\n")
    encode = codec().encode
    count, cycle, first_ns = 0, 0, clock.wall_ns(monotonic_now())

    def record(topic: Topic, message: Any, now_ns: int) -> None:
        nonlocal count
        recorder.write(topic, NAME, encode(topic, message), now_ns, now_ns)
        count += 1
        shared[: TRUTH.size] = TRUTH.pack(count, first_ns, now_ns)

    end = time.monotonic() + seconds
    due = time.monotonic()
    empty = np.zeros(0, np.float32)
    names = np.zeros(0, np.uint8), np.zeros(0, np.uint16), np.zeros(0, np.uint16)
    now_ns = first_ns
    geometry = MSG.SkinGeometry(
        header(now_ns, "ee"),
        "serial",
        "finger",
        [],
        *names,
        empty,
        empty,
        empty,
        np.zeros(0, np.bool_),
    )
    record(GEOMETRY, geometry, now_ns)
    while time.monotonic() < end:
        now_ns = clock.wall_ns(monotonic_now())
        head = header(now_ns, "ee")
        forces = rng.normal(0, 1, 3 * TAXELS).astype(np.float32)
        status = np.zeros(TAXELS, np.uint8)
        bounds = np.full(TAXELS, 0.1, np.float32)
        taxels = np.array([TAXELS], np.uint16)
        record(
            FORCES,
            MSG.TaxelForces(
                head, now_ns, now_ns, 1e-4, cycle, taxels, forces, status, True, True, bounds
            ),
            now_ns,
        )
        zero, origin = MSG.Vector3(0.0, 0.0, 0.0), MSG.Point(0.0, 0.0, 0.0)
        features = MSG.ContactFeatures(
            head, now_ns, now_ns, 1e-4, cycle, True, [], True, float(forces[0]), 1, origin,
            1.0, MSG.Wrench(zero, zero), 0.5, 0.1, 3, 0, [], [], 0.1, 0.1, 0.1,
        )  # fmt: skip
        record(FEATURES, features, now_ns)
        none = np.zeros(0, np.uint32), np.zeros(0, np.uint8)
        raw = rng.integers(0, 256, 600, np.uint8)
        record(RAW, MSG.RawChunk(head, now_ns, 0, *none, raw), now_ns)
        cycle += 1
        now = time.monotonic()
        due = max(due + 1 / RATE_HZ, now)  # do not catch up, as a board that was read late does not
        time.sleep(due - now)
    recorder.close()


def main(argv: Sequence[str] | None = None) -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args(argv)
    run(options.directory, options.truth, options.seed, options.seconds)


if __name__ == "__main__":
    main()
