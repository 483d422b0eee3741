"""reachd as a real process with faults around it: rows of the fault table."""

from __future__ import annotations

import math
import signal
from typing import Any

import pytest
from mcap.reader import make_reader

from tactile_core.bus import commanding
from tactile_core.bus.messages import codec
from tactile_core.bus.topics import REACH_EVENT
from tests.support.waiting import wait_until

NEAR = ("--strategy", "straight", "--target", "0.04,0.0", "--seed", "1")
FAR = ("--strategy", "straight", "--target", "0.36,0.0", "--seed", "1")


def test_frozen_arm_state_latches_the_gate(lab: Any) -> None:
    """Stamps and sequence advance, values do not: the arm moves unobserved."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*FAR, "--no-log", *lab.patient("arm_frozen"))
    # A starved arm gets its commands too late to move, which is the same to reachd.
    wait_until(lambda: arm.travelled > 0.01 or not program.running)
    arm.freeze()
    before = arm.travelled
    assert program.wait() == 1, program.said
    assert "does not change although the arm is told to move" in program.said
    lab.wait_for_codes("intervention", "arm_frozen")
    lab.wait_until_told_to_stop()
    # Told to move on for 0.3 s and what a busy machine adds, at 4 cm/s: not far.
    assert arm.travelled - before < 0.2


@pytest.mark.parametrize("hours", [1, -1])
def test_system_clock_step_changes_nothing(
    hours: int, lab: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Row 17: the wall clocks of the processes step while the arm moves (not the machine's)."""
    (lab.folder / "sitecustomize.py").write_text(
        "import os.path, time\n"
        "seconds, nanoseconds = time.time, time.time_ns\n"
        f"step = lambda: {3600 * hours} if os.path.exists({str(lab.folder / 'now')!r}) else 0\n"
        "time.time = lambda: seconds() + step()\n"
        "time.time_ns = lambda: nanoseconds() + step() * 10**9\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(lab.folder))
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*NEAR, "--log", "trial.mcap", *lab.patient())
    (lab.folder / "now").touch()
    assert program.wait() == 0, program.said
    assert arm.travelled > 0.03
    # Inputs that seemed older by an hour would have ended it, for a minute is allowed.
    assert not set(lab.codes("intervention")) & {"clock_backwards", "features_future",
                                                 "arm_future", "loop_late"}  # fmt: skip
    with (lab.folder / "trial.mcap").open("rb") as file:
        stamps = [
            (message.log_time, message.publish_time)
            for _, _, message in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert len(stamps) > 100
    logged = [log for log, _ in stamps]
    assert max(logged) - min(logged) < 1800e9
    assert all(abs(log - published) < 600e9 for log, published in stamps)


@pytest.mark.parametrize("side", ["board", "arm"])
def test_silent_network_stops_the_arm(side: str, lab: Any) -> None:
    """Row 19: no session ends and every liveliness token stays; only the age shows it."""
    arm = lab.arm
    wire = lab.wire(lab.reachd_at if side == "board" else lab.arm_at)
    lab.board(via=wire.endpoint if side == "board" else None)
    strict = ("features_stale", "features_lost") if side == "board" else ("arm_stale", "arm_lost")
    via = wire.endpoint if side == "arm" else None
    program = lab.reach(*FAR, "--no-log", *lab.patient(*strict), via=via)
    wire.cut()
    if side == "board":
        wait_until(lab.stopped)
    else:  # nor can reachd's zero reach it: its commands expire
        wait_until(lambda: not arm.moving)
    assert program.wait() == 1, program.said
    assert "NOT REACHED (held)" in program.said
    lost = "no valid features for" if side == "board" else "no arm state for"
    assert lost in program.said
    wire.mend()
    wait_until(lambda: not arm.moving or all(h.still for h in arm.heard[-3:]))


def test_short_network_silence_is_survived(lab: Any) -> None:
    """Delayed data that come all at once are old, and are not acted on."""
    arm = lab.arm
    wire = lab.wire(lab.reachd_at)
    lab.board(via=wire.endpoint)
    program = lab.reach(*FAR, "--no-log", *lab.patient("features_stale"))
    wire.cut()
    wait_until(lab.stopped)
    wire.mend()
    wait_until(lambda: arm.moving)
    program.signal(signal.SIGTERM)
    assert program.wait() == 1


def test_load_at_the_limit_stops_motion_against_it(lab: Any) -> None:
    """Row 25, from the arm's own state: the features show no contact."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*FAR, "--no-log", *lab.patient())

    def at_full_speed() -> bool:
        last = [h.vx for h in arm.heard[-10:]]
        return len(last) == 10 and last[0] > 0.03 and max(last) - min(last) < 1e-6

    wait_until(at_full_speed, explain=lambda: (lab.codes("intervention"), program.said, arm.x))
    fast = arm.heard[-1].vx
    arm.force = (-13.5, 0.0, 0.0)  # 90 %: half of the approach is left
    wait_until(lambda: all(h.vx < 0.6 * fast for h in arm.heard[-10:]))
    arm.force = (-15.0, 0.0, 0.0)
    wait_until(lambda: all(h.vx <= 1e-9 for h in arm.heard[-10:]))
    lab.wait_for_codes("intervention", "wrench")
    arm.force = (0.0, 0.0, 0.0)
    wait_until(
        lambda: arm.heard[-1].vx > 0.8 * fast,
        explain=lambda: (fast, lab.codes("intervention"), program.said[-900:]),
    )
    program.signal(signal.SIGTERM)
    assert program.wait() == 1


def test_timed_out_target_ends_in_zero(lab: Any) -> None:
    """Row 36."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*FAR, "--no-log", *lab.patient(), "--time-limit", "1.5")
    assert program.wait() == 1, program.said
    assert "NOT REACHED (timeout)" in program.said
    assert "not reached within 1.5 s" in program.said
    lab.wait_until_told_to_stop()
    assert arm.travelled > 0.0


@pytest.fixture
def loyal_arm(lab: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """An arm that keeps its commander also while a starved machine makes that one silent."""
    monkeypatch.setattr(commanding, "TAKEOVER", 60.0)
    monkeypatch.setattr(commanding, "FIRST_COMMAND", 60.0)
    return lab.arm


def test_second_reachd_on_the_bus_is_refused(loyal_arm: Any, lab: Any) -> None:
    """Row 35 where no lock is shared, as between two machines."""
    arm, _ = loyal_arm, lab.board()
    first = lab.reachd("--serve", "--strategy", "straight", "--no-log", *lab.patient())
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    wait_until(lambda: arm.arbiter.commander)
    locks = lab.folder / "elsewhere"
    locks.mkdir()
    for _ in range(5):
        second = lab.reachd(
            *NEAR, "--no-log", "--connect", lab.reachd_at, "--name", "other",
            listen="tcp/127.0.0.1:0", TACTILE_RUNTIME_DIR=str(locks),
        )  # fmt: skip
        assert second.wait() == 3
        if "on this bus" in second.said:  # else the arm was heard before there was a link to reachd
            break
    assert "commanded by another reachd (reach 'reach') on this bus" in second.said
    assert first.process.poll() is None
    assert all(h.still for h in arm.heard)


def test_second_reachd_seeing_only_the_arm_is_refused(loyal_arm: Any, lab: Any) -> None:
    """Row 35 by the arm itself: no lock is shared, and no link but that to the arm."""
    arm, _ = loyal_arm, lab.board()
    lab.reachd("--serve", "--strategy", "straight", "--no-log", *lab.patient())
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    wait_until(lambda: arm.arbiter.commander)
    locks = lab.folder / "elsewhere"
    locks.mkdir()
    for how in (("--serve",), NEAR):
        second = lab.reachd(
            *how, "--no-log", "--name", "other",
            listen="tcp/127.0.0.1:0", TACTILE_RUNTIME_DIR=str(locks),
        )  # fmt: skip
        assert second.wait() == 3, second.said
        assert "commanded by another reachd (reach 'reach')" in second.said
    assert arm.arbiter.commander.startswith("reach-")
    wait_until(lab.arms)
    assert lab.ask("status")["armed"] is True


def test_restarted_arm_driver_is_claimed_again(lab: Any) -> None:
    """Row 45: the gate latches meanwhile, and the arm must be claimed again."""
    arm, _ = lab.arm, lab.board()
    program = lab.reachd("--serve", "--strategy", "straight", "--no-log", *lab.patient())
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    wait_until(lab.arms)
    lab.ask("goal", {"x": 0.36, "y": 0.0})
    wait_until(lambda: arm.moving)
    first = arm.arbiter.commander
    arm.arbiter.forget()
    wait_until(lambda: lab.ask("status")["held"] == "commander")
    assert "obeys nobody's commands" in lab.ask("status")["outcome"]["text"]
    wait_until(lambda: arm.arbiter.commander not in ("", first))
    wait_until(lab.arms)
    program.signal(signal.SIGTERM)
    assert program.wait() == 0
    assert arm.arbiter.commander == "", "given back"


@pytest.mark.parametrize("delay", [0.25, 0.07])
def test_commands_delayed_in_transit_latch(delay: float, lab: Any) -> None:
    """Row 37: states come without delay; the arm drops old commands, and reachd notices."""
    arm, _ = lab.arm, lab.board()
    wire = lab.wire(lab.arm_at)
    program = lab.reach(*FAR, "--no-log", *lab.patient("echo_late", "echo_lost"), via=wire.endpoint)
    wait_until(lambda: arm.travelled > 0.005 or not program.running)
    wire.delay = delay
    before = arm.travelled
    assert program.wait() == 1, program.said
    assert "NOT REACHED (held)" in program.said
    assert "come into force" in program.said
    wait_until(lambda: not arm.moving)
    assert arm.travelled - before < 0.06


@pytest.mark.parametrize("how", ["backwards", "sideways", "fast"])
def test_arm_deviating_from_commands_latches(how: str, lab: Any) -> None:
    """Row 38."""
    arm, _ = lab.arm, lab.board()
    arm.does = {
        "backwards": lambda v: (-v[0], -v[1], -v[2]),
        "sideways": lambda v: (-v[1], v[0], v[2]),
        "fast": lambda v: (5 * v[0], 5 * v[1], 5 * v[2]),
    }[how]
    program = lab.reach(*FAR, "--no-log", *lab.patient("arm_tracking", "arm_speed", "arm_stale"))
    assert program.wait() == 1, program.said
    wait_until(lambda: {"arm_tracking", "arm_speed"} & set(lab.codes("intervention")))
    assert not math.isclose(arm.travelled, 0.0)
    assert arm.travelled < 0.1, "what it goes in 150 ms, and what a busy machine adds"


def test_operator_messages_are_shown(lab: Any) -> None:
    """Checks that are off and limits beyond the caps are shown at the start, in status and log."""
    _, _ = lab.arm, lab.board()
    config = lab.folder / "reach.toml"
    config.write_text('[parameters.safety]\ndisabled = ["skin_overload"]\nforce = 45.0\n')
    program = lab.reachd("--serve", "--log", "trial.mcap", "--config", str(config))
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    cautions = lab.ask("status")["cautions"]
    assert cautions == ["the check skin_overload is off", "force is 45, beyond the cap of 30"]
    program.signal(signal.SIGTERM)
    assert program.wait() == 0
    for caution in cautions:
        assert f"WARNING safety: {caution}" in program.said
    with (lab.folder / "trial.mcap").open("rb") as file:
        said = [
            codec().decode(REACH_EVENT, m.data).text
            for _, c, m in make_reader(file).iter_messages(topics=["/reach/reach/event"])
        ]
    assert set(cautions) <= set(said)
