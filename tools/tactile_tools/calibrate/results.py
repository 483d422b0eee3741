"""Results of an evaluation as JSON and as a table."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from rich.table import Table

from tactile_core.calibration.force_model import TARGET_UNITS
from tactile_tools.calibrate.evaluate import Judged, predict
from tactile_tools.calibrate.limits import limits

DEFINITIONS = {
    "tail20": "each recording by itself: delay, model and penalty chosen and fitted on its first "
    "80 % of frames, tested on all labels after them; labels of -1 (no reading) are not scored",
    "leave-one-out": "each recording whole, first press included, by a model chosen and fitted on "
    "the others alone; labels of -1 (no reading) are not scored",
}
AIMS = {
    ("tail20", "normal"): 0.18,
    ("tail20", "shear"): 0.12,
    ("tail20", "location"): 0.5,
    ("leave-one-out", "normal"): 0.35,
}


def as_json(split: str, judged: Sequence[Judged]) -> dict[str, Any]:
    """All results, for a file or another program."""
    return {
        "version": version("tactile-reach"),
        "split": split,
        "definition": DEFINITIONS[split],
        "recordings": [_one(each) for each in judged],
        "summary": summary(split, judged),
    }


def summary(split: str, judged: Sequence[Judged]) -> dict[str, dict[str, Any]]:
    """Error by target: over all tested labels, and the mean of the recordings."""
    groups: dict[str, list[Judged]] = defaultdict(list)
    for each in judged:
        groups["location" if not each.recording.forces else each.model.targets[0]].append(each)
    out: dict[str, dict[str, Any]] = {}
    for name, members in groups.items():
        squares = np.concatenate([(m.errors**2).mean(axis=1) for m in members])
        value = math.sqrt(float(squares.mean()))
        aim = AIMS.get((split, name))
        out[name] = {
            "rmse": value,
            "mean_of_recordings": float(np.mean([_overall(m) for m in members])),
            "unit": TARGET_UNITS[members[0].model.targets[0]],
            "labels": len(squares),
        }
        if name == "location":
            distance = np.concatenate([np.linalg.norm(m.errors, axis=1) for m in members])
            out[name] |= {
                "mean_distance": float(distance.mean()),
                "median_distance": float(np.median(distance)),
            }
        if aim is not None:
            out[name] |= {"aim": aim, "met": out[name]["mean_of_recordings"] <= aim}
    return out


def table(split: str, judged: Sequence[Judged]) -> Table:
    """Make a table of the errors for a terminal."""
    shown = Table(title=f"tactile calibrate evaluate --split {split}")
    for heading in ("recording", "target", "rmse", "bias", "worst", "labels", "model", "delay"):
        shown.add_column(heading, justify="left" if heading in ("recording", "model") else "right")
    for each in judged:
        for i, target in enumerate(each.model.targets):
            error, unit = each.errors[:, i], TARGET_UNITS[target]
            shown.add_row(
                each.recording.name,
                target,
                f"{each.rmse[i]:.3f} {unit}",
                f"{error.mean():+.3f}",
                f"{np.abs(error).max():.2f}",
                str(len(error)),
                f"{each.model.recipe}, penalty {each.choice.penalty:g}",
                f"{each.model.delay_s:+.2f} s",
            )
    return shown


def _overall(judged: Judged) -> float:
    return math.sqrt(float((judged.errors**2).mean()))


def _one(judged: Judged) -> dict[str, Any]:
    choice, recording = judged.choice, judged.recording
    guess = predict(judged.model, recording, label_clock=False)
    stamped = np.sqrt(((guess - judged.measured)[judged.tested] ** 2).mean(axis=0))
    targets = {}
    for i, target in enumerate(judged.model.targets):
        error = judged.errors[:, i]
        measured = judged.measured[judged.tested, i]
        targets[target] = {
            "rmse": float(judged.rmse[i]),
            "rmse_as_stamped": float(stamped[i]),
            "mean_absolute": float(np.abs(error).mean()),
            "bias": float(error.mean()),
            "worst": float(np.abs(error).max()),
            "unit": TARGET_UNITS[target],
            "range": [float(measured.min()), float(measured.max())],
        }
    return {
        "recording": judged.recording.name,
        "started": judged.recording.started,
        "labels_tested": int(judged.tested.sum()),
        "labels_total": len(judged.tested),
        "targets": targets,
        "model": {
            "recipe": judged.model.recipe,
            "penalty": choice.penalty,
            "delay_s": choice.delay_s,
            "features": judged.model.features.size,
        },
        "label_clock": None
        if recording.label_clock is None
        else {
            "beat_s": recording.label_clock.beat_s,
            "reading_s": recording.label_clock.reading_s,
            "jumps": recording.label_clock.jumps,
            "concentration": recording.label_clock.concentration,
        },
        "cross_validation": {
            "candidates": [
                {"recipe": s.recipe.name, "penalty": s.penalty, "rmse": s.rmse}
                for s in choice.scores
            ],
            "delays": [{"delay_s": d, "rmse": e} for d, e in choice.delays],
        },
        "limits": limits(judged),
    }
