"""``tactile fuzz``: spoil millions of frames and prove that none is accepted for another."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tactile_tools.fuzzers.can import CanFuzzer
from tactile_tools.fuzzers.serial import SerialFuzzer

BLOCK = 20_000
"""Frames under one seed: the same blocks whatever the number of processes."""

CAN_SHARE = 4
"""One block in so many is CAN transfers."""

Totals = dict[str, Any]
Progress = Callable[[int], None]


def run_fuzz(frames: int, seed: int, progress: Progress | None = None, jobs: int = 1) -> Totals:
    """Spoil ``frames`` frames and transfers; the totals are the same for any ``jobs``.

    ``progress`` is told how many frames more are done. ``wrong`` in the result counts messages
    accepted that were not sent; ``lost`` never exceeds ``lost_allowed``: the frames touched, one
    more for each that lost its end, and on CAN for each stray frame. ValueError for frames < 1.
    """
    if frames < 1 or jobs < 1 or seed < 0:
        raise ValueError(f"frames {frames}, jobs {jobs}: at least 1 each; seed {seed}: at least 0")
    blocks = [
        (seed, number, min(BLOCK, frames - start))
        for number, start in enumerate(range(0, frames, BLOCK))
    ]
    started = time.monotonic()
    media: dict[str, Totals] = {}
    for totals in _results(blocks, jobs):
        _add(media.setdefault(totals.pop("medium"), {}), totals)
        if progress is not None:
            progress(totals["touched"])
    result: Totals = {"seed": seed, "asked": frames}
    for name in ("touched", "sent", "accepted", "wrong", "lost", "lost_allowed"):
        result[name] = sum(m[name] for m in media.values())
    result["blocks_beyond_allowed_loss"] = sum(m["beyond"] for m in media.values())
    result["media"] = media
    result["seconds"] = round(time.monotonic() - started, 1)
    result["python"] = platform.python_version()
    return result


def _results(blocks: list[tuple[int, int, int]], jobs: int) -> Iterator[Totals]:
    if jobs == 1 or len(blocks) == 1:
        yield from map(_block, blocks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(_block, blocks)


def _block(job: tuple[int, int, int]) -> Totals:
    """Totals of one block; runs in a process of its own."""
    seed, number, frames = job
    rng = np.random.default_rng([seed, number])
    on_can = number % CAN_SHARE == CAN_SHARE - 1
    fuzzer = CanFuzzer(rng) if on_can else SerialFuzzer(rng)
    while fuzzer.touched < frames:
        fuzzer.run()
    fuzzer.finish()
    judge = fuzzer.judge
    allowed = fuzzer.touched + (fuzzer.strays if isinstance(fuzzer, CanFuzzer) else fuzzer.glued)
    return {
        "medium": "can" if on_can else "serial",
        "touched": fuzzer.touched,
        "sent": judge.sent,
        "accepted": judge.accepted,
        "wrong": judge.wrong,
        "lost": judge.lost,
        "lost_allowed": allowed,
        "beyond": int(judge.lost > allowed),
        "kinds": dict(fuzzer.kinds),
        "counters": fuzzer.counters,
    }


def _add(total: Totals, more: Totals) -> None:
    for name, value in more.items():
        if isinstance(value, dict):
            total[name] = dict(Counter(total.get(name, {})) + Counter(value))
        else:
            total[name] = total.get(name, 0) + value


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand ``fuzz``."""
    parser = subparsers.add_parser(
        "fuzz",
        help="spoil frames and check that none is accepted wrongly",
        description="Spoil serial frames and CAN transfers in every way and check that every "
        "message that the decoders accept is one that was sent. Exit code 1 if one was not.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--frames", type=_positive, default=1_000_000, help="frames to spoil")
    parser.add_argument("--seed", type=_natural, default=1, help="of all random choices")
    parser.add_argument("--jobs", type=_positive, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the totals here")
    parser.set_defaults(func=_main)


def _positive(text: str) -> int:
    value = _natural(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: at least 1")
    return value


def _natural(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text}: at least 0")
    return value


def _main(options: argparse.Namespace) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    if options.json is not None and not options.json.parent.is_dir():
        print(f"{options.json}: no directory {options.json.parent}; make it first", file=sys.stderr)
        return 2
    columns = ("[progress.description]{task.description}", BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task("frames spoilt", total=options.frames)
        result = run_fuzz(
            options.frames,
            options.seed,
            progress=lambda done: bar.advance(task, done),
            jobs=options.jobs,
        )
    if options.json is not None:
        try:
            options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            print(f"{options.json}: {error.strerror}; name another file", file=sys.stderr)
            return 3
    print(
        f"{result['touched']} frames spoilt, {result['wrong']} accepted wrongly; "
        f"{result['lost']} of {result['sent']} lost (allowed {result['lost_allowed']}) "
        f"in {result['seconds']} s"
    )
    return int(result["wrong"] > 0 or result["blocks_beyond_allowed_loss"] > 0)
