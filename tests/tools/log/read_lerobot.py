"""Read a data set back with LeRobot's own loader; run by an interpreter that has lerobot-dataset.

Prints what the test compares, as JSON: lengths, first and last frame, statistics.
"""

import json
import sys

from ledataset.datasets.lerobot_dataset import LeRobotDataset


def main() -> None:
    dataset = LeRobotDataset("local/tactile", root=sys.argv[1])
    first, last = dataset[0], dataset[len(dataset) - 1]
    wanted = {"observation.tactile": [-0.1, 0.0]}
    windows = LeRobotDataset("local/tactile", root=sys.argv[1], delta_timestamps=wanted)
    print(
        json.dumps(
            {
                "frames": len(dataset),
                "episodes": dataset.num_episodes,
                "fps": dataset.fps,
                "lengths": list(dataset.meta.episodes["length"]),
                "names": dataset.meta.features["observation.tactile"]["names"],
                "first": first["observation.tactile"].tolist(),
                "last": last["observation.tactile"].tolist(),
                "action": first["action"].tolist(),
                "task": first["task"],
                "timestamp": float(last["timestamp"]),
                "window": list(windows[len(dataset) - 1]["observation.tactile"].shape),
                "mean": dataset.meta.stats["observation.tactile"]["mean"].tolist(),
            }
        )
    )


if __name__ == "__main__":
    main()
