"""Streams one velocity to an arm until it is killed: ``streaming_commander.py ENDPOINT SPEED``."""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tactile_core.bus.services import ServiceError
from tactile_core.types import Twist
from tests.support.commander import Commander
from tests.support.waiting import wait_until


def main(endpoint: str, speed: float) -> None:
    commander = Commander(endpoint, "process")

    def claimed() -> bool:
        try:
            commander.claim()
            commander.limit()
        except ServiceError:
            return False
        return True

    wait_until(claimed)
    commander.twist = Twist(speed, 0.0, 0.0)
    print("streaming", flush=True)
    time.sleep(3600)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
