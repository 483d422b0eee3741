"""Record two seconds of a board into a file of its own: python record.py [BOARD [NAME]]."""

import sys
import time

import tactile_reach as tr


def main(name: str | None = None, file: str | None = None) -> None:
    """Record what tactiled publishes while the block runs."""
    with tr.connect() as bus:
        board = bus.board(name)
        with board.record(file) as path:
            time.sleep(2.0)
        print(path)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except tr.TactileError as error:
        sys.exit(f"record: {error}")
