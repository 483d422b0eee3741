"""Describe a calibration file in words."""

from __future__ import annotations

from typing import Any

from tactile_core.calibration import BoardCalibration
from tactile_core.calibration.force_model import TARGET_UNITS


def as_dict(calibration: BoardCalibration) -> dict[str, Any]:
    """Contents of a calibration, without its matrices."""
    return {
        "serial_number": calibration.serial_number,
        "model": calibration.model,
        "created": calibration.created,
        "provenance": calibration.provenance,
        "nominal": calibration.nominal,
        "hash": calibration.hash,
        "arrays": [
            {"name": a.geometry.name, "taxels": a.geometry.taxels} for a in calibration.arrays
        ],
        "models": [
            {
                "recipe": net.recipe,
                "targets": {t: TARGET_UNITS[t] for t in net.targets},
                "features": net.features.size,
                "layers": [f"{la.kind} {la.inputs}→{la.outputs}" for la in net.layers],
                "taus_s": net.features.taus_s.tolist(),
                "play_operators": len(net.features.radii),
                "follows_rest": net.features.tracker is not None,
                "label_delay_s": net.delay_s,
                "figures": [
                    {"name": f.name, "value": f.value, "unit": f.unit, "how": f.how}
                    for f in net.figures
                ],
            }
            for net in calibration.nets
        ],
    }


def as_text(calibration: BoardCalibration) -> str:
    """Contents of a calibration as lines of text."""
    d = as_dict(calibration)
    arrays = ", ".join(f"{a['name']} ({a['taxels']} taxels)" for a in d["arrays"])
    lines = [
        f"board      {d['serial_number']} ({d['model']}): {arrays}",
        f"created    {d['created']}",
        f"from       {d['provenance']}",
        f"kind       {'typical figures, not of this board' if d['nominal'] else 'measured'}",
        f"hash       {d['hash'][:16]}",
    ]
    if not d["models"]:
        lines.append("models     none: matrices of the taxels alone, linear and without history")
    for model in d["models"]:
        targets = ", ".join(f"{t} ({u})" for t, u in model["targets"].items())
        history = []
        if model["taus_s"]:
            history.append("creep over " + ", ".join(f"{t:g}" for t in model["taus_s"]) + " s")
        if model["play_operators"]:
            history.append(f"hysteresis by {model['play_operators']} play operators")
        if model["follows_rest"]:
            history.append("rest followed")
        lines += [
            f"model      {model['recipe']}: {targets} from {model['features']} features, "
            + " → ".join(model["layers"]),
            f"  history  {'; '.join(history) or 'none'}",
            f"  labels   {1000 * model['label_delay_s']:+.0f} ms behind the field, taken out",
        ]
        seen: dict[str, None] = {}
        for figure in model["figures"]:
            lines.append(f"  error    {figure['value']:.3f} {figure['unit']}  {figure['name']}")
            seen[figure["how"]] = None
        lines += [f"  how      {how}" for how in seen]
    return "\n".join(lines)
