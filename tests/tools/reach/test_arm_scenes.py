"""``tactile arm-scenes``: what it counts, and going on where it was cut off."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tactile_tools.dev.arm_scenes import summary


def row(seed: int, arm: str, success: bool, text: str = "") -> dict[str, object]:
    return {
        "scene_seed": seed, "arm": arm, "success": success, "reason": "held", "text": text
    }  # fmt: skip


def test_summary_counts_each_arm_and_pairs_them() -> None:
    rows = [row(s, "simulated", s != 0) for s in range(4)]
    rows += [row(s, "ur", s > 1, f"went {s}.5 mm astray") for s in range(4)]
    found = summary(rows, ["simulated", "ur"])
    assert (found["simulated"]["reached"], found["ur"]["reached"]) == (3, 2)
    assert found["ur"]["failures"] == {"held: went … mm astray": 2}
    pair = found["ur against simulated"]
    assert (pair["only_simulated"], pair["only_ur"], pair["difference"]) == (1, 0, -0.25)
    low, high = found["ur"]["wilson_95"]
    assert low < 0.5 < high


def test_reach_behind_the_guard_is_kept_and_not_made_again(tmp_path: Path) -> None:
    out = tmp_path / "ur.json"
    words = ["arm-scenes", "--lockstep", "--arm", "ur", "--strategy", "straight", "--scenes", "1"]
    assert main([*words, "--out", str(out)]) == 0
    first = json.loads(out.read_text())
    assert [r["arm"] for r in first["reaches"]] == ["ur"]
    assert main([*words, "--out", str(out)]) == 0
    assert json.loads(out.read_text()) == first


def test_result_of_other_settings_is_not_mixed_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ur.json"
    settings = {"scene": "hardware", "strategy": "straight", "time_limit_s": 20.0}
    out.write_text(json.dumps(settings | {"arms": ["ur"], "lockstep": True, "reaches": []}))
    assert main(["arm-scenes", "--lockstep", "--arm", "ur", "--out", str(out)]) == 2
    assert "made with scene hardware" in capsys.readouterr().err
    out.write_text("[]")
    assert main(["arm-scenes", "--lockstep", "--arm", "ur", "--out", str(out)]) == 2
    assert "not a result of this command" in capsys.readouterr().err
