"""Print what a board feels: python read_features.py [BOARD [COUNT]]."""

import sys

import tactile_reach as tr


def main(name: str | None = None, count: int = 20) -> None:
    """Print ``count`` values of board ``name``; without a name, of the only board."""
    with tr.connect() as bus, bus.board(name).features(timeout_s=30.0) as stream:
        for _ in range(count):
            f = next(stream)
            if not f.valid:
                print("not valid:", "; ".join(f.reasons))
                continue
            print(
                f"{f.normal_force:6.2f} ± {f.normal_force_bound:.2f} N  shear {f.shear_force:.2f} N"
            )
            for patch in f.patches:
                x, y, z = (1e3 * part for part in patch.centroid)
                print(
                    f"    {patch.side}: {patch.normal_force:.2f} N at {x:.0f}, {y:.0f}, {z:.0f} mm"
                )


if __name__ == "__main__":
    try:
        words = sys.argv[1:]
        main(words[0] if words else None, int(words[1]) if words[1:] else 20)
    except tr.TactileError as error:
        sys.exit(f"read_features: {error}")
