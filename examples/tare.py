"""Tare a board: python tare.py [BOARD]. Lift the skin off everything first."""

import sys

import tactile_reach as tr


def main(name: str | None = None) -> None:
    """Tare; if it is refused because the skin seems touched, tare by force."""
    with tr.connect() as bus:
        board = bus.board(name)
        try:
            print(board.tare())
        except tr.RefusedError as refusal:
            print("refused:", refusal)
            print(board.tare(force=True))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2])
    except tr.TactileError as error:
        sys.exit(f"tare: {error}")
