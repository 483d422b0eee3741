"""A training run: what it learns from, that it goes on where it was cut off, what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("torch", reason="no torch: pip install 'tactile-reach[learn]'")
pytest.importorskip("numba", reason="no numba: pip install 'tactile-reach[train]'")

import torch

from reachd.strategies.learned import load_policy
from reachd.strategies.memory import WIDTH
from reachd.strategies.parameters import SETS
from tactile_tools.cli import main
from tactile_tools.train.cupboards import PRIVILEGED
from tactile_tools.train.ppo import ACTIONS, Batch, Learner, Noise, advantages_of
from tactile_tools.train.run import Run, RunError
from tactile_tools.train.settings import Learning, Scenes, Settings

SMALL = Settings(
    worlds=8,
    judge_every=1000,
    learning=Learning(hidden=(16,), decisions=4, minibatches=2),
    scenes=Scenes(count=2, judged=1),
)


def test_advantages_follow_their_definition() -> None:
    """δ_k + γλ δ_{k+1} + …, cut where a reach ends (Schulman et al. 2016, equation 16)."""
    generator = torch.Generator().manual_seed(0)
    t, n, discount, trace = 5, 3, 0.9, 0.8
    rewards = torch.randn((t, n), generator=generator)
    values = torch.randn((t + 1, n), generator=generator)
    ended = torch.zeros((t, n), dtype=torch.bool)
    ended[2, 1] = True
    empty = torch.zeros((t, n, 1))
    batch = Batch(empty, empty, empty, rewards, rewards, ended, values)
    found, returns = advantages_of(batch, discount, trace)
    for w in range(n):
        for k in range(t):
            total, weight = 0.0, 1.0
            for j in range(k, t):
                following = 0.0 if ended[j, w] else discount * values[j + 1, w]
                total += weight * (rewards[j, w] + following - values[j, w])
                if ended[j, w]:
                    break
                weight *= discount * trace
            assert float(found[k, w]) == pytest.approx(float(total), abs=1e-5)
    assert torch.equal(returns, found + values[:-1])


def test_learner_moves_towards_what_was_rewarded() -> None:
    learner = Learner(Learning(hidden=(16,), epochs=4, rate=3e-3), "cpu", 0)
    generator = torch.Generator().manual_seed(0)
    t, n = 8, 64
    for _ in range(15):
        seen = torch.randn((t, n, WIDTH), generator=generator)
        hidden = torch.zeros((t, n, PRIVILEGED))
        draws = torch.randn((t, n, ACTIONS), generator=generator)
        drawn = [learner.act(seen[k], hidden[k], draws[k]) for k in range(t)]
        actions = torch.stack([d[0] for d in drawn])
        rewards = -((actions[:, :, 0] - 0.6) ** 2)
        values = torch.stack([*(d[2] for d in drawn), drawn[-1][2]])
        ended = torch.ones((t, n), dtype=torch.bool)
        chances = torch.stack([d[1] for d in drawn])
        batch = Batch(seen, hidden, actions, chances, rewards, ended, values)
        learner.learn(batch, generator)
    seen = torch.randn((200, WIDTH), generator=generator)
    mean = learner.policy({})(seen.numpy()).mean(0)
    assert mean[0] > 0.25
    assert abs(mean[1]) < 0.2
    # What runs on the arm is what was trained.
    assert learner.mean(seen).numpy() == pytest.approx(learner.policy({})(seen.numpy()), abs=1e-5)


@pytest.mark.parametrize("lasting", [0.0, 0.5, 1.0])
def test_noise_is_standard_normal_and_the_lasting_share_decays(lasting: float) -> None:
    """Correlation over k decisions: share · exp(-k · 0.1 s / time constant)."""
    noise = Noise(4000, lasting, 0.5, torch.Generator().manual_seed(0))
    draws = torch.stack([noise.draw() for _ in range(12)]).numpy()
    assert draws.dtype == np.float32
    assert draws.mean() == pytest.approx(0.0, abs=0.01)
    assert draws.std() == pytest.approx(1.0, abs=0.01)
    for k in (1, 5, 10):
        together = float((draws[k:] * draws[:-k]).mean())
        assert together == pytest.approx(lasting * np.exp(-0.1 * k / 0.5), abs=0.015)


def test_run_goes_on_where_it_was_cut_off(tmp_path: Path) -> None:
    said: list[str] = []
    first = Run(tmp_path / "run", SMALL, "cpu", 1, said.append)
    first.go(1.0)
    batches = first.batches
    assert batches >= 1
    again = Run(tmp_path / "run", SMALL, "cpu", 1, said.append)
    assert (again.batches, again.decisions) == (batches, batches * 8 * 4)
    seen = np.zeros((1, again.learner.actor[0].in_features), np.float32)
    assert np.array_equal(again.learner.policy({})(seen), first.learner.policy({})(seen))
    again.go(0.5)
    assert again.batches > batches
    rows = [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").open()]
    assert [r["batch"] for r in rows if "loss" in r] == list(range(1, again.batches + 1))
    about = load_policy(tmp_path / "run" / "learned.npz").about
    assert about["settings"]["worlds"] == 8
    assert about["base"]["authors_sim"]["sweep_angle"] == SETS["authors_sim"].sweep_angle
    assert about["judged"]["reaches"] == 1
    assert (tmp_path / "run" / "curve.png").stat().st_size > 5000
    with pytest.raises(RunError, match="other settings"):
        Run(tmp_path / "run", Settings(), "cpu", 1, said.append)


def test_command_trains_and_names_what_it_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, out = tmp_path / "train.toml", tmp_path / "run"
    config.write_text("worlds = 8\n[learning]\nhidden = [8]\n[scenes]\ncount = 1\njudged = 1\n")
    words = ["train", "--config", str(config), "--out", str(out), "--minutes", "0.01"]
    assert main([*words, "--jobs", "1"]) == 0
    assert f"learned_weights={out / 'learned.npz'}" in capsys.readouterr().out
    assert load_policy(out / "last-learned.npz").about["decisions"] >= 8 * 24
    assert main(["train", "--out", str(out), "--minutes", "0.01"]) == 2
    assert "other settings" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["train", "--minutes", "0"])


def test_missing_gpu_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(RunError, match="no GPU"):
        Run(tmp_path / "run", SMALL, "cuda", 1, lambda _: None)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    with pytest.raises(RunError, match="numba-cuda"):
        Run(tmp_path / "run", SMALL, "cuda", 1, lambda _: None)
    assert not (tmp_path / "run").exists()


def test_run_begins_with_the_networks_of_another(tmp_path: Path) -> None:
    """In wider layers, too, and as yet it does the same."""
    first = Run(tmp_path / "narrow", SMALL, "cpu", 1, lambda _: None)
    for parameter in first.learner.actor.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    first.save()
    wide = msgspec.structs.replace(SMALL, learning=Learning(hidden=(24,), decisions=4))
    again = Run(tmp_path / "wide", wide, "cpu", 1, lambda _: None, tmp_path / "narrow")
    seen = torch.randn((20, WIDTH), generator=torch.Generator().manual_seed(0))
    assert again.learner.mean(seen).numpy() == pytest.approx(
        first.learner.mean(seen).numpy(), abs=1e-5
    )
    assert first.learner.mean(seen).std() > 0.1
    assert again.about()["started_from"] == "0.0 M decisions of another run"
    other = msgspec.structs.replace(SMALL, learning=Learning(hidden=(8, 8), decisions=4))
    with pytest.raises(RunError, match="number of layers"):
        Run(tmp_path / "other", other, "cpu", 1, lambda _: None, tmp_path / "narrow")
    small = msgspec.structs.replace(SMALL, learning=Learning(hidden=(8,), decisions=4))
    with pytest.raises(RunError, match="wider than here"):
        Run(tmp_path / "small", small, "cpu", 1, lambda _: None, tmp_path / "narrow")
    with pytest.raises(RunError, match="name the folder of a run"):
        Run(tmp_path / "none", SMALL, "cpu", 1, lambda _: None, tmp_path / "nothing")


@pytest.mark.parametrize("name", ["checkpoint.pt", "scenes.jsonl.gz"])
def test_spoilt_file_of_a_run_is_named(name: str, tmp_path: Path) -> None:
    Run(tmp_path, SMALL, "cpu", 1, lambda _: None)
    (tmp_path / name).write_bytes(b"cut off")
    with pytest.raises(RunError, match=f"{name}.*delete it"):
        Run(tmp_path, SMALL, "cpu", 1, lambda _: None).go(0.1)
