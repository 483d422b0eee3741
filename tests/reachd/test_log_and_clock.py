"""Neither bus messages nor log or clock faults end reachd or its log (rows 42, 43)."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from reachd.inputs import FEATURES, Input, make_arm_state, make_touch
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import ServiceError
from tactile_core.bus.streams import ATTACHMENT, BusSample
from tactile_core.bus.topics import ARM_STATE, TF
from tactile_core.log.info import info
from tactile_core.types import NS_PER_S, Instant
from tests.support.waiting import wait_until

NEAR = ("--strategy", "straight", "--target", "0.04,0.0", "--seed", "1")

Until = Callable[..., None]


def test_unrepresentable_stamp_does_not_end_the_log(lab: Any) -> None:
    lab.arm, lab.board()
    program = lab.reachd("--serve", "--log", "trial.mcap", *lab.patient())
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    for stamp in (-1, -(1 << 63), (1 << 63) - 1):
        lab.arm.session.put(
            TF.template, b"\0\1\0\0", attachment=ATTACHMENT.pack(1, stamp, 16, b"X" * 16)
        )
    wait_until(lambda: lab.ask("status")["log"]["marked"] == 2)
    before = lab.ask("status")["log"]["written"]
    wait_until(lambda: lab.ask("status")["log"]["written"] > before + 100)
    assert lab.ask("status")["log"]["state"] == "recording"
    wait_until(lab.arms)
    with pytest.raises(ServiceError, match="nothing to stop"):
        lab.ask("stop", {"reason": "\x1b[2J" * 7000})
    program.signal(signal.SIGTERM)
    assert program.wait() == 0, program.said
    assert info(lab.folder / "trial.mcap").whole


def test_no_reach_starts_without_the_requested_log(lab: Any) -> None:
    arm, _ = lab.arm, lab.board()
    program = lab.reachd("--serve", "--strategy", "straight", "--log", "logs", *lab.patient())
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    wait_until(lab.arms)
    logs: Path = lab.folder / "logs"
    logs.rename(lab.folder / "gone")
    logs.touch()  # a file in place of the folder, so that no log can be opened
    wait_until(lambda: lab.ask("status")["log"]["state"] == "io_error")
    with pytest.raises(ServiceError, match=r"is not being written \(io_error.*--no-log"):
        lab.ask("goal", {"x": 0.36, "y": 0.0})
    assert not arm.moving
    program.signal(signal.SIGTERM)
    assert program.wait() == 1, program.said
    assert "reachd: the log failed" in program.said
    assert "Traceback" not in program.said


@pytest.mark.parametrize(
    ("wall_s", "says"), [(-86_400 + 3600, "1969-12-31"), (2**31 + 86_400, "2038-01-20")]
)
def test_reach_runs_at_any_system_time(
    wall_s: int, says: str, lab: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (lab.folder / "sitecustomize.py").write_text(
        "import time\n"
        f"shift, seconds, nanoseconds = {wall_s} - time.time(), time.time, time.time_ns\n"
        "time.time = lambda: seconds() + shift\n"
        "time.time_ns = lambda: nanoseconds() + int(shift * 1e9)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(lab.folder))
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*NEAR, "--log", "trial.mcap", *lab.patient())
    assert program.wait() == 0, program.said
    assert f"the system clock reads {says}" in program.said
    assert arm.travelled > 0.03
    told = info(lab.folder / "trial.mcap")
    assert told.whole
    assert says in told.metadata["software"]["clock_problem"]
    assert {c.topic: c.messages for c in told.channels}["/reach/reach/state"] > 50


@pytest.mark.parametrize("topic", [FEATURES, ARM_STATE], ids=["features", "arm"])
@pytest.mark.parametrize("remote", [False, True])
def test_inputs_survive_any_bytes_and_stamps(topic: Any, remote: bool) -> None:
    """Fifty thousand damaged messages, each from a new publisher."""
    rng = random.Random(42)
    make: Any = make_touch if topic is FEATURES else make_arm_state
    taken: Input[Any] = Input(topic, make, 0.2, remote=remote)
    good = codec().encode(topic, _features() if topic is FEATURES else _arm())
    for k in range(12_500):
        data = bytearray(good)
        for _ in range(rng.randrange(8)):
            data[rng.randrange(len(data))] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
        if rng.random() < 0.2:
            data = data[: rng.randrange(len(data))]
        wall_ns = rng.choice((None, -(1 << 63), (1 << 63) - 1, 0))
        sequence = rng.choice((None, 0, -1, (1 << 63) - 1, k))
        sample = BusSample(topic.template, bytes(data), sequence, wall_ns, rng.randbytes(16))
        taken.take(sample, Instant(k * NS_PER_S))
    counted = {name: n for name, n in taken.counters.items() if n}
    assert sum(n for name, n in counted.items() if name != "accepted") > 2000
    assert taken.counters["accepted"] > 1000


def _features() -> Any:
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    return MSG.ContactFeatures(
        header(0, "ee"), 0, 0, 0.0, 1, True, ["tare"], True, 9.0, 1, MSG.Point(0.0, 0.0, 0.0),
        9.0, MSG.Wrench(zero, zero), 0.0, 0.0, 1, 0, [], ["tare"], 0.1, 0.1, 0.1,
    )  # fmt: skip


def _arm() -> Any:
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    twist, wrench = MSG.Twist(zero, zero), MSG.Wrench(zero, zero)
    return MSG.ArmState(
        header(0, "cupboard"), 1, 2, 0.1, -0.2, 0.3, twist, wrench, "moving", 0.05, 0.35, 10.0, 1.5,
        "", 0, 0,
    )  # fmt: skip
