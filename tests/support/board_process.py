"""Publish a board's features on the bus without a board. Run as a process, to be stopped."""

from __future__ import annotations

import sys
import time

from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.session import BusConfig, open_session
from tactile_core.bus.streams import declare_alive, declare_publisher
from tactile_core.bus.topics import FEATURES
from tactile_core.types import WallClock, monotonic_now


def main(endpoint: str, board: str, ahead: float, prefix: str) -> None:
    """Publish valid features of a free finger at 100 Hz, stamped ``ahead`` s from now, forever."""
    session = open_session(BusConfig(listen=(), connect=(endpoint,)))
    wall = WallClock.take()
    publisher = declare_publisher(session, FEATURES, board, prefix)
    token = declare_alive(session, board)
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    sequence = 0
    while token is not None:
        now = monotonic_now()
        sequence += 1
        stamp = now + round(ahead * 1e9)
        message = MSG.ContactFeatures(
            header=header(wall.wall_ns(now), "ee"),
            captured_ns=stamp,
            received_ns=stamp,
            uncertainty=0.0,
            sequence=sequence,
            valid=True,
            reasons=[],
            calibrated=True,
            peak_force=0.0,
            peak_side=0,
            peak_position=MSG.Point(0.0, 0.0, 0.0),
            normal_force=0.0,
            wrench=MSG.Wrench(zero, zero),
            tip_force=0.0,
            tip_contact_time=0.0,
            taxels_in_contact=0,
            taxels_masked=0,
            patches=[],
            reason_codes=[],
            peak_force_bound=0.1,
            normal_force_bound=0.1,
            tip_force_bound=0.1,
        )
        publisher.put(codec().encode(FEATURES, message), wall.wall_ns(now))
        time.sleep(0.01)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), sys.argv[4])
