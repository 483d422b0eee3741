"""How a daemon's process ends: at once, when all that it has to do is done."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from typing import NoReturn


def leave(code: int) -> NoReturn:
    """End the process with ``code``; the last call of a command.

    The interpreter is not taken down piece by piece: a thread of zenoh, or of a driver, that comes
    back into it meanwhile would hang or abort the process after everything was closed in order.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # its reader has gone
            stream.flush()
    os._exit(code)
