"""Scenes recorded in the authors' simulator, and the outcomes of its trials in them."""

from __future__ import annotations

import csv
import gzip
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sim_device.world.parameters import world_parameters
from sim_device.world.scenes import Pose, Scene, SceneError, SceneObject, Shape

RECORDED = "authors_sim_recorded"
"""``Scene.source`` of these scenes."""

AUTHORS_UNIT: Final = 0.1
"""Metres per length unit of the authors' simulator."""

MAX_BYTES = 16 << 20
"""Largest decompressed size; a larger file is not ours. Sixty scenes take 0.4 MB."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One trial of the reference.

    ``distance``: from tip to goal at the end, over the cupboard's depth. ``success``: ended within
    1 mm. ``entered``: came within 7.5 mm; ``entered_step``: the step of 1/240 s when it did.
    ``duration``: over the time limit. ``normal_force``: median, 90th percentile and maximum over
    the trial of the normal forces summed over the arm, N. ``ejected``: objects past the front.
    """

    seed: int
    strategy: str
    objects: int
    distance: float
    success: bool
    entered: bool
    entered_step: int | None
    duration: float
    excavations_ccw: int
    excavations_cw: int
    normal_force: tuple[float, float, float]
    ejected: int


def _unreadable(path: Path, error: Exception, wanted: str) -> SceneError:
    why = getattr(error, "strerror", None) or error  # not Python's "[Errno 2]"
    return SceneError(f"cannot read {path}: {why}; name a file like {wanted}")


def load_recorded(path: Path) -> tuple[Scene, ...]:
    """Scenes of ``scenes_*.json.gz``, in the file's order; SceneError says what is wrong."""
    try:
        with gzip.open(path, "rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise _unreadable(path, error, "scenes_*.json.gz") from None
    if len(data) > MAX_BYTES:
        raise SceneError(f"{path} unpacks to more than {MAX_BYTES} bytes")
    try:
        raw = json.loads(data)["scenes"]
        return tuple(_scene(entry) for entry in raw)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise SceneError(f"{path} is not a file of recorded scenes: {error!r}") from None


def load_outcomes(path: Path) -> tuple[Outcome, ...]:
    """Rows of ``outcomes_*.csv``; SceneError names the line."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            return tuple(_outcome(path, reader.line_num, row) for row in reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _unreadable(path, error, "outcomes_*.csv") from None


def _scene(entry: dict[str, Any]) -> Scene:
    """Scene at true scale from the authors' units."""
    base, goal = entry["arm_base"], entry["goal"]
    parameters = world_parameters("authors_sim")
    return Scene(
        source=RECORDED,
        parameters=parameters.name,
        seed=int(entry["seed"]),
        depth=parameters.depth,
        width=parameters.width,
        start=Pose(base[0] * AUTHORS_UNIT, base[1] * AUTHORS_UNIT, 0.0),
        goal=(goal[0] * AUTHORS_UNIT, goal[1] * AUTHORS_UNIT),
        objects=tuple(_object(o) for o in entry["objects"]),
    )


def _object(entry: dict[str, Any]) -> SceneObject:
    """Object at true scale; its roll and pitch, below 2°, are dropped."""
    dims: Sequence[float] = entry["dims"]
    x, y, z, w = entry["quat"]
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    match entry["shape"]:
        case "cylinder":
            shape, height, size = Shape.DISC, dims[0], (2 * dims[1], 2 * dims[1])
        case "rectangle":
            shape, height, size = Shape.BOX, dims[2], (dims[0], dims[1])
        case other:
            raise SceneError(f"shape {other!r} is neither cylinder nor rectangle")
    return SceneObject(
        shape=shape,
        size_x=size[0] * AUTHORS_UNIT,
        size_y=size[1] * AUTHORS_UNIT,
        height=height * AUTHORS_UNIT,
        mass=float(entry["mass"]),
        x=entry["pos"][0] * AUTHORS_UNIT,
        y=entry["pos"][1] * AUTHORS_UNIT,
        yaw=yaw,
    )


def _outcome(path: Path, line: int, row: dict[str, str]) -> Outcome:
    """One row of the table."""
    try:
        step = row["step_enter_075"]
        return Outcome(
            seed=int(row["seed"]),
            strategy=row["strategy"],
            objects=int(row["num_obs"]),
            distance=float(row["norm_dist"]),
            success=row["success_ref"] == "1",
            entered=row["success_075_enter"] == "1",
            entered_step=int(float(step)) if step else None,
            duration=float(row["comp_norm"]),
            excavations_ccw=int(row["n_ccw"]),
            excavations_cw=int(row["n_cw"]),
            normal_force=(
                float(row["sum_force_p50"]),
                float(row["sum_force_p90"]),
                float(row["sum_force_max"]),
            ),
            ejected=int(row["objs_out_front"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path} line {line}: {error!r}") from None
