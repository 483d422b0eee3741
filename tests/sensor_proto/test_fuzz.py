"""The fuzzer: no frame is wrongly accepted, runs repeat exactly, and a fault would be detected."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sensor_proto import can_transfers, framing
from tactile_tools.cli import main
from tactile_tools.dev import fuzz
from tactile_tools.dev.fuzzers.can import KINDS as CAN_KINDS
from tactile_tools.dev.fuzzers.messages import random_messages
from tactile_tools.dev.fuzzers.serial import KINDS as SERIAL_KINDS


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "BLOCK", 1500)


@pytest.mark.usefixtures("small_blocks")
def test_no_corrupted_frame_is_accepted() -> None:
    done: list[int] = []
    result = fuzz.run_fuzz(12_000, seed=3, progress=done.append)
    assert result["touched"] == sum(done) >= 12_000
    assert result["wrong"] == 0
    assert result["sent"] == result["accepted"] + result["lost"]
    assert result["accepted"] > result["touched"] / 10  # the line still carries traffic
    assert result["blocks_beyond_allowed_loss"] == 0
    for medium, kinds in (("serial", SERIAL_KINDS), ("can", CAN_KINDS)):
        totals = result["media"][medium]
        assert set(totals["kinds"]) == set(kinds)
        assert totals["counters"]["accepted"] == totals["accepted"]
        assert totals["counters"]["crc"] > 100  # much of it reaches the CRC check


def test_fuzz_run_is_determined_by_its_seed() -> None:
    first, second, other = (fuzz.run_fuzz(800, seed=s) for s in (1, 1, 2))
    for result in (first, second, other):
        del result["seconds"]
    assert first == second != other


@pytest.mark.usefixtures("small_blocks")
def test_result_is_independent_of_process_count() -> None:
    alone, together = (fuzz.run_fuzz(3500, seed=5, jobs=jobs) for jobs in (1, 2))
    del alone["seconds"], together["seconds"]
    assert alone == together


@pytest.mark.usefixtures("small_blocks")
def test_fuzzer_detects_a_decoder_without_crc(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (framing, can_transfers):
        monkeypatch.setattr(module, "intact", lambda packets: [True] * len(packets))
    result = fuzz.run_fuzz(6000, seed=1)
    assert result["media"]["serial"]["wrong"] > 50
    assert result["media"]["can"]["wrong"] > 20


def test_messages_of_every_type_are_sent() -> None:
    import numpy as np

    kinds = {type(m) for m in random_messages(np.random.default_rng(0), 60)}
    assert len(kinds) == 13


@pytest.mark.parametrize("arguments", [(0, 1, 1), (10, -1, 1), (10, 1, 0)])
def test_misuse_is_refused(arguments: tuple[int, int, int]) -> None:
    frames, seed, jobs = arguments
    with pytest.raises(ValueError, match="at least"):
        fuzz.run_fuzz(frames, seed, jobs=jobs)


def run(*words: str) -> int:
    return main(["fuzz", *words])


def test_the_command_writes_its_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fuzz.json"
    assert run("--frames", "500", "--seed", "4", "--jobs", "1", "--out", str(out)) == 0
    assert json.loads(out.read_text())["wrong"] == 0
    assert "0 accepted wrongly" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--frames", "0"], ["--jobs", "x"], ["--seed", "-1"]])
def test_bad_arguments_exit_with_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        run(*words)
    assert error.value.code == 2
    assert words[0] in capsys.readouterr().err


def test_missing_directory_is_named_before_work_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--out", str(tmp_path / "absent" / "fuzz.json")) == 2
    assert "absent" in capsys.readouterr().err
