"""Read a log into pandas: python read_log.py FILE.mcap [BOARD]."""

import sys

import tactile_reach as tr


def main(path: str, board: str | None = None) -> None:
    """Print the greatest force of each second."""
    log = tr.read_log(path)
    names = sorted({topic.split("/")[2] for topic in log if topic.endswith("/features")})
    features = log.board(board or names[0])["features"]
    frame = features.to_pandas()
    valid = frame[frame["valid"]]
    print(f"{len(frame)} features, {len(valid)} of them valid")
    print(valid.groupby(valid.index.astype(int))["normal_force"].max().rename("N").round(2))
    force = log.board(board or names[0])["forces"]["force"]  # one row per message
    print(f"forces of {force.shape[1] // 3} taxels at {len(force)} instants")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except (tr.TactileError, KeyError) as error:
        sys.exit(f"read_log: {error}")
