"""A board in thirty lines: the bytes of an AnySkin on a pseudo-terminal.

    python fake_board.py ./pad &
    tactiled --port ./pad --kind anyskin

Five chips send temperature (°C) and field (µT) as float32, then CR LF, 100 times a second. Every
four seconds something seems to press on the chip in the middle. A board that you design yourself
should rather speak our protocol (PROTOCOL.md), which has checksums, numbers and device time.
"""

import contextlib
import os
import pty
import random
import struct
import sys
import time
import tty
from pathlib import Path

CHIPS, PERIOD_S = 5, 0.01


def frame(seconds: float, noise: random.Random) -> bytes:
    """Bytes that the board sends ``seconds`` after power-on."""
    pressed = max(0.0, seconds % 4.0 - 2.0) if seconds > 4.0 else 0.0
    values = []
    for chip in range(CHIPS):
        share = 1.0 if chip == 0 else 0.2
        field = (20.0, -15.0, 40.0 + 60.0 * share * min(pressed, 1.0))
        values += [25.0, *(part + noise.gauss(0.0, 0.5) for part in field)]
    return struct.pack(f"<{4 * CHIPS}f", *values) + b"\r\n"


def main(path: str) -> None:
    """Stream to ``path`` until killed."""
    board, port = pty.openpty()
    tty.setraw(port)
    os.set_blocking(board, False)
    Path(path).unlink(missing_ok=True)
    Path(path).symlink_to(os.ttyname(port))
    noise, start, sent = random.Random(1), time.monotonic(), 0
    while True:
        sent += 1
        time.sleep(max(0.0, start + sent * PERIOD_S - time.monotonic()))
        with contextlib.suppress(BlockingIOError):  # the bytes are lost when nobody reads
            os.write(board, frame(sent * PERIOD_S, noise))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "./pad")
