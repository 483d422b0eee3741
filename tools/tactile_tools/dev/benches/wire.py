"""Decoding speed: our serial frames, and the AnySkin stream beside AnySkin's own host loop."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pty
import struct
import time
import tty
from collections.abc import Callable

import numpy as np
import serial

from sensor_proto.anyskin import AnySkinDecoder, encode_anyskin
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import FloatSamples, Samples

FRAME_BYTES = 250
FRAMES = 2000
READ_BYTES = 4095  # what one read of a busy tty returns at most
MAGNETOMETERS = 5
IN_A_ROW = 10
BURST = 45  # frames written at once: below the 4,000 bytes at which the baseline throws all away


def bench_decode(*, quick: bool = False) -> dict[str, float]:
    """Return ``decode_fps``: serial frames of about 250 bytes per second on one core."""
    rng = np.random.default_rng(0)
    taxels = next(n for n in range(1, 129) if len(_samples(rng, 0, n)) >= FRAME_BYTES)
    stream = b"".join(_samples(rng, s, taxels) for s in range(FRAMES))
    chunks = [stream[i : i + READ_BYTES] for i in range(0, len(stream), READ_BYTES)]

    def decode() -> int:
        decoder = SerialDecoder()
        got = sum(len(decoder.feed(chunk)) for chunk in chunks)
        if got != FRAMES:
            raise RuntimeError(f"{got} of {FRAMES} frames were decoded: {decoder.counters}")
        return got

    seconds = _median_cpu_seconds(decode, 5 if quick else 21)
    return {"decode_fps": FRAMES / seconds, "decode_frame_bytes": len(stream) / FRAMES}


def bench_anyskin(*, quick: bool = False) -> dict[str, float]:
    """Return ``anyskin_speedup``: CPU time of AnySkin's host loop over ours, same bytes, same pty.

    The published loop runs in its own process and passes each sample through shared memory;
    ``anyskin_speedup_bare`` leaves that out. Ours decodes to arrays, burst by burst;
    ``anyskin_speedup_one_by_one`` makes an object of every frame instead.
    """
    rng = np.random.default_rng(0)
    burst = b"".join(_anyskin_frame(rng) for _ in range(BURST))
    rounds = 10 if quick else 60
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        with serial.Serial(os.ttyname(slave)) as port:
            shared = _SharedSample()
            ours_s, single_s, loop_s, bare_s = [], [], [], []
            decoder = AnySkinDecoder(MAGNETOMETERS)
            for _ in range(rounds):
                ours_s.append(_timed(lambda: _ours(port, decoder), master, burst))
                single_s.append(_timed(lambda: _ours_one_by_one(port, decoder), master, burst))
                loop_s.append(_timed(lambda: _baseline(port, shared), master, burst))
                bare_s.append(_timed(lambda: _baseline(port, None), master, burst))
            if decoder.counters["accepted"] < (2 * rounds * IN_A_ROW - 1) * BURST:
                raise RuntimeError(f"frames were lost in the benchmark: {decoder.counters}")
    finally:
        os.close(master)
        os.close(slave)
    ours = float(np.median(ours_s))
    return {
        "anyskin_speedup": float(np.median(loop_s)) / ours,
        "anyskin_speedup_bare": float(np.median(bare_s)) / ours,
        "anyskin_speedup_one_by_one": float(np.median(loop_s) / np.median(single_s)),
        "anyskin_us_per_frame": ours / BURST * 1e6,
    }


def _samples(rng: np.random.Generator, sequence: int, taxels: int) -> bytes:
    counts = rng.normal(0, 2000, (taxels, 3)).astype(np.int16)
    status = np.zeros(taxels, np.uint8)
    return encode_serial(Samples(0, sequence, sequence * 10_000, 2500, counts, status))


def _anyskin_frame(rng: np.random.Generator) -> bytes:
    field = rng.normal(0, 1000, (MAGNETOMETERS, 3)).astype(np.float32)
    celsius = rng.normal(25, 0.1, MAGNETOMETERS).astype(np.float32)
    return encode_anyskin(FloatSamples(field, celsius, np.zeros(MAGNETOMETERS, np.uint8)))


def _median_cpu_seconds(work: Callable[[], object], repeats: int) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds))


def _timed(read_all: Callable[[], None], master: int, burst: bytes) -> float:
    """CPU seconds to read a burst that is already in the tty; mean of several in a row.

    In a row, because otherwise each reader would pay for the caches that the other one has filled.
    """
    spent = 0.0
    for _ in range(IN_A_ROW):
        os.write(master, burst)
        start = time.process_time()
        read_all()
        spent += time.process_time() - start
    return spent / IN_A_ROW


def _ours(port: serial.Serial, decoder: AnySkinDecoder) -> None:
    """Do what tactiled does with a burst: read what there is, decode."""
    left = BURST * (16 * MAGNETOMETERS + 2)
    while left:
        data = port.read(port.in_waiting or 1)
        left -= len(data)
        decoder.feed_bursts(data)


def _ours_one_by_one(port: serial.Serial, decoder: AnySkinDecoder) -> None:
    """Do the same with an object for every frame, as tactiled needs it for stamps."""
    left = BURST * (16 * MAGNETOMETERS + 2)
    while left:
        data = port.read(port.in_waiting or 1)
        left -= len(data)
        decoder.feed(data)


class _SharedSample:
    """Shared memory of the published loop for its parent process: time, reading and count."""

    def __init__(self) -> None:
        self.time = multiprocessing.Value(ctypes.c_double)
        self.reading = multiprocessing.Array(ctypes.c_float, 3 * MAGNETOMETERS)
        self.count = multiprocessing.Value(ctypes.c_uint64)


def _baseline(port: serial.Serial, shared: _SharedSample | None) -> None:
    """Do for one burst what the AnySkin library's host loop does, sample by sample.

    It asks how many bytes wait (once against overflow, once for a whole frame), reads just one
    frame, checks CR LF, unpacks with a format string made each time, makes an array and drops the
    temperatures. Its busy waiting for the next frame costs nothing here: the bytes are there.
    """
    size = 16 * MAGNETOMETERS + 2
    floats = 4 * MAGNETOMETERS
    keep = np.ones(floats, bool)
    keep[::4] = False
    for _ in range(BURST):
        if port.in_waiting > 4000:
            port.reset_input_buffer()
        while port.in_waiting < size:
            pass
        stamp = time.time()
        raw = port.read(size)
        if raw[-2:] != b"\r\n":
            raise RuntimeError("the baseline lost its place")
        sample = np.array(struct.unpack(f"@{floats}fcc", raw)[:floats])[keep]
        if shared is not None:
            shared.time.value, shared.reading[:] = stamp, sample
            with shared.count.get_lock():
                shared.count.value += 1
