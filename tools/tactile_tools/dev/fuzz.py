"""``tactile fuzz``: corrupt millions of frames and check that none is accepted as another.

``--through pipeline``: instead, pass frames with arbitrary content and right CRCs through
tactiled's links and pipeline.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import multiprocessing
import platform
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_tools.dev.fuzzers.can import CanFuzzer
from tactile_tools.dev.fuzzers.serial import SerialFuzzer

if TYPE_CHECKING:
    from tactile_tools.dev.fuzzers.pipeline import Kind

BLOCK = 20_000
"""Frames per seed: the blocks are the same for any number of processes."""

CAN_SHARE = 4
"""One block in so many consists of CAN transfers."""

PIPELINE_BLOCK = 4000
"""Hostile frames per seed, between an honest second and an honest board again."""

PIPELINE_KINDS: tuple[Kind, ...] = ("serial", "can", "floats")
"""Kinds of port, taken in turn."""

Totals = dict[str, Any]
Progress = Callable[[int], None]


def run_fuzz(frames: int, seed: int, progress: Progress | None = None, jobs: int = 1) -> Totals:
    """Corrupt ``frames`` frames and transfers; the totals are the same for any ``jobs``.

    ``progress`` is called with the number of frames done since the last call. ``wrong`` in the
    result counts messages accepted that were not sent. ``lost`` never exceeds ``lost_allowed``: the
    frames corrupted, one more for each that lost its end, and on CAN for each stray frame.
    ValueError for frames < 1.
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


def run_pipeline(
    mutations: int,
    seed: int,
    progress: Progress | None = None,
    jobs: int = 1,
    *,
    first: int = 0,
    seconds: float = math.inf,
) -> Totals:
    """Pass ``mutations`` hostile frames with right CRCs through links and pipeline, in blocks.

    A block can be repeated by its number; ``failures`` lists the blocks in which something failed.
    ``first``: number to begin at. ``seconds``: begin no block after this time. ``next_block`` in
    the result: where to go on.
    """
    if mutations < 1 or jobs < 1 or seed < 0 or first < 0:
        raise ValueError(
            f"mutations {mutations}, jobs {jobs}: at least 1 each; seed {seed}, block {first}: "
            "at least 0"
        )
    blocks = [
        (seed, first + number, min(PIPELINE_BLOCK, mutations - start))
        for number, start in enumerate(range(0, mutations, PIPELINE_BLOCK))
    ]
    started = time.monotonic()
    media: dict[str, Totals] = {}
    failures: list[Totals] = []
    done = 0
    for totals in _pipeline_results(blocks, jobs, started + seconds):
        done += 1
        if totals["failure"]:
            failures.append({key: totals[key] for key in ("block", "medium", "failure")})
        counted = {k: v for k, v in totals.items() if k not in ("block", "failure", "medium")}
        _add(media.setdefault(totals["medium"], {}), counted)
        if progress is not None:
            progress(totals["mutated"])
    return {
        "seed": seed,
        "asked": mutations,
        "blocks": len(blocks),
        "mutated": sum(m["mutated"] for m in media.values()),
        "first_block": first,
        "next_block": first + done,
        "failures": failures,
        "media": media,
        "seconds": round(time.monotonic() - started, 1),
        "python": platform.python_version(),
    }


def _pipeline_results(
    blocks: list[tuple[int, int, int]], jobs: int, end: float
) -> Iterator[Totals]:
    """Blocks in the order of their numbers; none is begun after ``end`` (monotonic s)."""
    if jobs == 1 or len(blocks) == 1:
        for block in blocks:
            if time.monotonic() >= end:
                return
            yield _pipeline_block(block)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for at in range(0, len(blocks), jobs):
            if time.monotonic() >= end:
                return
            yield from pool.map(_pipeline_block, blocks[at : at + jobs])


def _pipeline_block(job: tuple[int, int, int]) -> Totals:
    """Totals of one block; runs in its own process."""
    from tactile_tools.dev.fuzzers.pipeline import PipelineFuzzer

    seed, number, mutations = job
    kind = PIPELINE_KINDS[number % len(PIPELINE_KINDS)]
    logging.disable(logging.CRITICAL)  # every false claim is logged, thousands of times
    fuzzer = PipelineFuzzer(kind, np.random.default_rng([seed, number]))
    failure = ""
    try:
        fuzzer.run(mutations)
    except Exception as error:  # noqa: BLE001 - any exception at all is a finding
        failure = "".join(traceback.format_exception(error)[-4:])
    finally:
        logging.disable(logging.NOTSET)
    sink = fuzzer.sink
    return {
        "block": number,
        "medium": kind,
        "failure": failure,
        "mutated": fuzzer.mutated,
        "kinds": dict(fuzzer.kinds),
        "messages": sink.sent,
        "features": sink.features,
        "features_valid": sink.valid,
        "oversized": sink.oversized,
    }


def _results(blocks: list[tuple[int, int, int]], jobs: int) -> Iterator[Totals]:
    if jobs == 1 or len(blocks) == 1:
        yield from map(_block, blocks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(_block, blocks)


def _block(job: tuple[int, int, int]) -> Totals:
    """Totals of one block; runs in its own process."""
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


def run(options: argparse.Namespace) -> int:
    """Fuzz. Returns 1 if something was accepted wrongly or failed."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    if options.out is not None and not options.out.parent.is_dir():
        print(
            f"{options.out}: no such folder {options.out.parent}; create it first", file=sys.stderr
        )
        return 2
    columns = ("[progress.description]{task.description}", BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task("frames corrupted", total=options.frames)
        result = _fuzz(options, lambda done: bar.advance(task, done))
    if options.out is not None:
        try:
            options.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            print(f"{options.out}: {error.strerror}; name another file", file=sys.stderr)
            return 3
    if options.through == "pipeline":
        return _report_pipeline(result)
    print(
        f"{result['touched']} frames corrupted, {result['wrong']} accepted wrongly; "
        f"{result['lost']} of {result['sent']} lost (allowed {result['lost_allowed']}) "
        f"in {result['seconds']} s"
    )
    return int(result["wrong"] > 0 or result["blocks_beyond_allowed_loss"] > 0)


def _fuzz(options: argparse.Namespace, progress: Progress) -> Totals:
    if options.through == "decoder":
        return run_fuzz(options.frames, options.seed, progress=progress, jobs=options.jobs)
    return run_pipeline(
        options.frames,
        options.seed,
        progress,
        options.jobs,
        first=options.from_block,
        seconds=options.duration,
    )


def _report_pipeline(result: Totals) -> int:
    """Print the result. Returns the exit status."""
    failures = result["failures"]
    oversized = sum(m["oversized"] for m in result["media"].values())
    print(
        f"{result['mutated']} frames with right CRCs, blocks {result['first_block']} to "
        f"{result['next_block'] - 1}: {len(failures)} blocks failed, {oversized} messages too "
        f"large for the bus, in {result['seconds']} s"
    )
    for failure in failures[:10]:
        last = failure["failure"].strip().splitlines()[-1]
        print(f"block {failure['block']} ({failure['medium']}): {last}")
    if result["next_block"] - result["first_block"] < result["blocks"]:
        print(f"go on with --from-block {result['next_block']}")
    return int(bool(failures or oversized))
