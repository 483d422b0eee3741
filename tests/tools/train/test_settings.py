"""Settings of a training run, and what `tactile train` refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactile_core.config import ConfigError, load_toml
from tactile_tools.cli import main
from tactile_tools.train.settings import JUDGING_SEEDS, Settings


def test_settings_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "train.toml"
    path.write_text("worlds = 64\n[learning]\nhidden = [32]\n[variety]\ntaxels = 1.0\n")
    settings = load_toml(path, Settings)
    assert (settings.worlds, settings.learning.hidden, settings.variety.taxels) == (64, (32,), 1.0)
    assert settings.learning.discount == Settings().learning.discount


@pytest.mark.parametrize(
    "text",
    [
        "worlds = 0\n",
        "[learning]\nhidden = []\n",
        "[variety]\ntaxels = 1.5\n",
        "[reward]\nprogres = 1\n",
        "[scenes]\nfirst_seed = 700000\n",
        "[scenes]\njudged_seed = 700000\n",
    ],
)
def test_bad_settings_are_refused_by_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "train.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"train\.toml:\d+: "):
        load_toml(path, Settings)


def test_no_scene_of_the_benchmark_is_trained_on_or_chosen_by() -> None:
    scenes = Settings().scenes
    assert scenes.first_seed not in JUDGING_SEEDS
    assert scenes.judged_seed not in JUDGING_SEEDS
    assert scenes.judged_seed + scenes.judged <= scenes.first_seed


def test_bad_file_of_settings_ends_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch", reason="no torch: pip install 'tactile-reach[learn]'")
    path = tmp_path / "train.toml"
    path.write_text("worlds = -1\n")
    assert main(["train", "--config", str(path), "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "worlds" in line
    assert not (tmp_path / "run").exists()
