"""Cupboard as a real process: its arm on a real bus, its board on a real terminal."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from sim_device.board.catalogue import factory_calibration
from tactile_core.bus.messages import MSG, codec
from tactile_core.bus.services import ServiceError
from tactile_core.bus.streams import Tap, latest
from tactile_core.bus.topics import COMMAND, WORLD, alive_key
from tactile_core.types import NS_PER_S, Instant, Twist, monotonic_now
from tactiled.blocks import Cycle
from tactiled.boards.events import Sampled
from tactiled.boards.line import SerialLine
from tactiled.sensing.pipeline import BoardPipeline
from tactiled.transports.serial_port import SerialTransport
from tests.support.waiting import wait_until

AHEAD, BACK = Twist(0.05, 0.0, 0.0), Twist(-0.05, 0.0, 0.0)
STILL = 1e-4  # m/s
TRIES = 5

COMMANDER = textwrap.dedent("""
    import sys, time
    import msgspec
    from tactile_core.types import Twist
    from tactile_core.bus.commanding import ClaimRequest, Grant, Signer, clock_domain
    from tactile_core.bus.services import call
    from tactile_core.bus.session import BusConfig, open_session
    from tactile_core.bus.streams import Publisher
    session = open_session(BusConfig(listen=(), connect=(f"tcp/127.0.0.1:{sys.argv[1]}",)))
    request = ClaimRequest("other", clock_domain())
    signer = Signer(msgspec.convert(call(session, "arm/arm/srv/claim", request, 20), Grant))
    publisher = Publisher(session, "arm/arm/cmd_vel", "tactile_msgs/msg/ArmCommand")
    print("ready", flush=True)
    while True:
        data = signer.command(Twist(0.05, 0.0, 0.0), time.monotonic_ns(), 0.06, time.time_ns())
        publisher.put(data, time.time_ns())
        time.sleep(0.01)
""")

Wait = Callable[..., None]


def rest_after(cupboard: Any) -> float:
    """Seconds from the last command that the arm obeyed to the last state in which it moves."""
    cupboard.rest()
    last = cupboard.call("status")["last_command_ns"]
    moving = [s.captured_ns for s in cupboard.states if abs(s.twist.linear.x) > STILL]
    assert moving
    return float(max(moving) - last) / NS_PER_S


def test_cupboard_says_how_to_connect_and_announces_itself(cupboard: Any) -> None:
    arm, board = cupboard.said
    assert "reachd --strategy hybrid_event --set authors_sim --target 0.3580,0.1000" in arm
    assert board.startswith("board0: finger ")
    assert "tactiled --port board0" in board
    tokens = cupboard.session.liveliness().get(alive_key("arm", "arm"), timeout=60)
    assert [str(t.ok.key_expr) for t in tokens if t.ok is not None] == [alive_key("arm", "arm")]
    status = cupboard.call("status", kind="world")
    assert status["goal"] == [0.358, 0.1]
    seen = latest(cupboard.session, WORLD.key("world")).wait(60)
    assert seen is not None
    markers = codec().decode(WORLD, seen.data).markers
    by_name = {(m.ns, m.id): m for m in markers}
    goal, disc = by_name["goal", 0].pose.position, by_name["objects", 0]
    assert (goal.x, goal.y) == (0.358, 0.1)
    assert disc.pose.position.x == pytest.approx(0.02, abs=1e-3)
    assert disc.scale.x == pytest.approx(0.08)
    assert ("finger", 0) in by_name


def test_states_are_stamped_at_100_hz_under_any_load(cupboard: Any) -> None:
    first = len(cupboard.states)
    wait_until(lambda: len(cupboard.states) >= first + 150)
    states = cupboard.states[first:]
    stamps = np.array([s.captured_ns for s in states])
    # Late states are sent as well; the bus may drop one when a link is full.
    assert np.median(np.diff(stamps)) == 10_000_000
    assert (np.diff(stamps) > 0).all()
    assert stamps[-1] <= monotonic_now()
    numbers = [s.sequence for s in states]
    assert numbers == sorted(set(numbers))
    assert states[-1].f_max == 10.0


def test_command_moves_the_arm_and_its_end_stops_it(cupboard: Any) -> None:
    begin = cupboard.states[-1].x
    commander = cupboard.commander(AHEAD)
    wait_until(lambda: cupboard.states[-1].x > begin + 0.01)
    commander.stop()
    assert rest_after(cupboard) <= 0.1
    stood = cupboard.states[-1].x
    time.sleep(0.2)
    assert cupboard.states[-1].x == pytest.approx(stood, abs=1e-6)


@pytest.fixture
def other(cupboard: Any) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", COMMANDER, str(cupboard.port)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


def test_kill_9_of_the_commander_stops_the_arm(cupboard: Any, other: subprocess.Popen[str]) -> None:
    begin = cupboard.states[-1].x
    wait_until(lambda: cupboard.states[-1].x > begin + 0.005)
    os.kill(other.pid, signal.SIGSTOP)  # neither closes its socket nor speaks
    assert rest_after(cupboard) <= 0.1
    begin = cupboard.states[-1].x
    os.kill(other.pid, signal.SIGCONT)
    wait_until(lambda: cupboard.states[-1].x > begin + 0.005)
    os.kill(other.pid, signal.SIGKILL)
    assert rest_after(cupboard) <= 0.1


def kept_commander(cupboard: Any) -> Any:
    """A commander that moves the arm ahead, after another was refused.

    The other is granted only once the first has been silent, as on a starved machine.
    """
    for _ in range(TRIES):
        first = cupboard.commander(AHEAD)
        wait_until(lambda: cupboard.states[-1].mode == "moving")
        assert cupboard.states[-1].commander == first.grant.commander
        refusal = ""
        try:
            cupboard.commander(BACK, name="second")
        except ServiceError as error:
            refusal = str(error)
        if refusal:
            assert "another reachd (reach 'test')" in refusal
            return first
        own = [s for s in list(cupboard.states) if s.commander == first.grant.commander]
        assert own[-1].mode != "moving", "another was granted while it moved the arm"
        cupboard.reset()
    pytest.fail("the first commander was late every time")


def test_second_commander_is_refused_until_the_first_is_gone(cupboard: Any) -> None:
    first = kept_commander(cupboard)
    begin, count = cupboard.states[-1].x, len(cupboard.states)
    wait_until(lambda: cupboard.states[-1].x > begin + 0.015)
    assert min(s.twist.linear.x for s in cupboard.states[count:]) > -STILL
    first.stop()
    second = None
    while second is None:
        try:
            second = cupboard.commander(BACK, name="second")
        except ServiceError:
            time.sleep(0.05)
    wait_until(lambda: cupboard.states[-1].twist.linear.x < -0.01)
    state = cupboard.states[-1]
    assert state.commander == second.grant.commander
    assert state.command_sequence > 0
    second.stop()


def test_strangers_move_nothing_and_block_nobody(cupboard: Any) -> None:
    """Row 45: a stranger who reads all that the commander sends, and sends a hundred times more."""
    heard: list[bytes] = []
    tap = Tap(cupboard.session, COMMAND.key("arm"), lambda s: heard.append(s.data))
    owner = cupboard.commander(AHEAD)
    wait_until(lambda: cupboard.states[-1].mode == "moving")
    wait_until(lambda: heard)
    publisher = cupboard.publisher()
    back = MSG.Twist(MSG.Vector3(-0.3, 0.0, 0.0), MSG.Vector3(0.0, 0.0, 0.0))
    begin, count = cupboard.states[-1].x, len(cupboard.states)
    while cupboard.states[-1].x < begin + 0.02:
        message = codec().decode(COMMAND, heard[-1])
        message.twist = back
        for sequence in (message.sequence + 1, 2**60):
            message.sequence = sequence
            publisher.put(codec().encode(COMMAND, message), 1)
        message.commander = "evil-00000000"
        publisher.put(codec().encode(COMMAND, message), 1)
        publisher.put(heard[max(0, len(heard) - 50)], 1)  # as it came
        time.sleep(0.001)
    moved = cupboard.states[count:]
    # Its owner's commands may come late on a starved machine, so that it rests meanwhile.
    assert min(s.twist.linear.x for s in moved) > -STILL, "it never turned"
    assert {s.commander for s in moved} == {owner.grant.commander}
    for service, request in (
        ("limits", FACTORY),
        ("limits", FACTORY | {"commander": owner.grant.commander}),
        ("clear", {}),
        ("claim", {"name": "evil", "clock": ""}),
        ("release", {}),
    ):
        with pytest.raises(ServiceError, match=r"arm's commander|commanded by another"):
            cupboard.call(service, request)
    assert cupboard.states[-1].v_max == 0.05
    counters = cupboard.call("status")["counters"]
    assert all(counters[reason] > 0 for reason in ("forged", "foreign", "repeated"))
    owner.stop()
    tap.close()
    publisher.close()


FACTORY = {"v_max": 0.5, "omega_max": 1.0, "f_max": 100.0, "m_max": 20.0}


def test_damaged_oversized_and_anonymous_commands_move_nothing(cupboard: Any) -> None:
    before = cupboard.call("status")["counters"]
    signer, publisher = cupboard.claim(), cupboard.publisher()
    nameless = cupboard.session.declare_publisher("arm/arm/cmd_vel")

    def command(twist: Twist = AHEAD, ago: int = 0) -> bytes:
        return bytes(signer.command(twist, Instant(monotonic_now() - ago), 0.06, 1))

    def refused(reason: str) -> int:
        return int(cupboard.call("status")["counters"][reason])

    for reason, send in (
        ("malformed", lambda: publisher.put(command()[:40], 1)),
        ("forged", lambda: nameless.put(command()[:-16] + bytes(16))),
        ("oversized", lambda: nameless.put(command() + bytes(66_000))),
        ("late", lambda: publisher.put(command(ago=NS_PER_S), 1)),
        ("not_finite", lambda: publisher.put(command(Twist(math.nan, 0.0, 0.0)), 1)),
    ):
        # Repeatedly: on a busy machine one may come too late.
        wait_until(lambda send=send, reason=reason: send() or refused(reason) > before[reason])
    after = cupboard.call("status")["counters"]
    assert after["accepted"] == before["accepted"]
    assert {s.mode for s in cupboard.states[-20:]} <= {"ready", "stopped"}
    nameless.undeclare()


@pytest.mark.parametrize("delay", [0.25])
def test_commands_expire_by_decision_time_despite_delays(delay: float, cupboard: Any) -> None:
    """Row 37: a queue on the way holds commands decided before the stop."""
    begin = cupboard.states[-1].x
    commander = cupboard.commander(AHEAD)
    wait_until(lambda: cupboard.states[-1].x > begin + 0.005)
    late = cupboard.call("status")["counters"]["late"]
    commander.delay(delay)
    wait_until(lambda: cupboard.call("status")["counters"]["late"] > late + 10)
    commander.stop()
    stopped = monotonic_now()
    time.sleep(delay + 0.3)
    moving = [s.captured_ns for s in cupboard.states if abs(s.twist.linear.x) > STILL]
    assert max(moving) - stopped < 0.1 * NS_PER_S


def test_limits_are_confirmed_and_kept(cupboard: Any) -> None:
    asked = {"v_max": 0.02, "omega_max": 0.1, "f_max": 5.0, "m_max": 0.5}
    assert cupboard.call("limits", asked) == asked
    assert cupboard.call("clear") == {"mode": "ready"}
    commander = cupboard.commander(AHEAD)
    wait_until(lambda: cupboard.states[-1].twist.linear.x > 0.019)
    commander.stop()
    state = cupboard.states[-1]
    assert (state.v_max, state.omega_max, state.f_max, state.m_max) == tuple(asked.values())
    assert max(s.twist.linear.x for s in cupboard.states[-50:]) < 0.0205
    for bad in ({}, asked | {"f_max": -1}, asked | {"f_max": "much"}):
        with pytest.raises(ServiceError, match="bad request"):
            cupboard.call("limits", bad)


def test_contact_of_the_finger_shows_in_the_bytes_of_its_board(cupboard: Any) -> None:
    port = SerialTransport(str(cupboard.folder / "board0"), 115_200)
    port.open()
    line = SerialLine("board0", lambda *_: None, "tactile", 100.0)
    pipeline = BoardPipeline(factory_calibration("finger", 3))
    line.connect(monotonic_now())
    cycles: list[Cycle] = []

    def hear(enough: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60
        while not enough():
            assert time.monotonic() < deadline, "waited in vain"
            events = line.tick(monotonic_now())
            for payload in line.outgoing():
                port.write(payload)
            chunk = port.read(0.05)
            if chunk is not None:
                events = [*events, *line.receive(chunk)]
            for event in events:
                if isinstance(event.event, Sampled):
                    cycles.extend(pipeline.feed(event.event.block))

    try:
        hear(lambda: len(cycles) > 80 and cycles[-1].features.valid)
        free = max(c.features.tip_force for c in cycles[-20:])
        first = len(cupboard.states)
        commander = cupboard.commander(AHEAD)
        try:
            hear(lambda: cycles[-1].features.tip_force > free + 2.0)
        finally:
            commander.stop()
    finally:
        port.close()
    # 2 kg on the shelf: μ·m·g = 0.2 · 2 · 9.81 N keeps it moving; the impact is harder.
    wait_until(lambda: min(s.wrench.force.x for s in cupboard.states[first:]) < -2.0)
    assert free < 1.0


def test_reset_restores_arm_and_objects(cupboard: Any) -> None:
    commander = cupboard.commander(AHEAD)
    wait_until(lambda: cupboard.states[-1].x > -0.17)

    def refused() -> bool:
        try:
            cupboard.call("reset", kind="world")
        except ServiceError as error:
            return "moving: stop it first" in str(error)
        return False  # the commander was late, so that the arm rested just then

    wait_until(refused)
    commander.stop()
    cupboard.rest()
    reply = cupboard.call("reset", kind="world")
    assert (reply["goal"], reply["start"]) == ([0.358, 0.1], [-0.2, 0.0, 0.0])
    wait_until(lambda: cupboard.states[-1].x < -0.199)
    assert cupboard.states[-1].f_max == 10.0
    with pytest.raises(ServiceError, match="is one scene"):
        cupboard.call("reset", {"seed": 8}, kind="world")


def test_emergency_stop_cannot_be_cleared_while_pressed_and_ctrl_c_exits_cleanly(
    start: Any,
) -> None:
    cupboard = start("--arm-fault", "estop@0s+600s,refuses_limits", "--arm-rate", "200")
    factory = cupboard.call("limits", {"v_max": 0.05, "omega_max": 0.3, "f_max": 5.0, "m_max": 1.0})
    assert factory["v_max"] == 0.5
    commander = cupboard.commander(AHEAD)
    wait_until(lambda: cupboard.call("status")["counters"]["not_enabled"] > 30)
    with pytest.raises(ServiceError, match="for the arm's commander"):
        cupboard.call("clear")
    commander.stop()
    with pytest.raises(ServiceError, match="'estop' is still there"):
        cupboard.call("clear", commander.signer.sign("clear"))
    assert {s.mode for s in cupboard.states} == {"estop"}
    assert cupboard.states[-1].x == pytest.approx(-0.2, abs=1e-6)
    code, errors = cupboard.end()
    assert code == 0
    assert "not_enabled" in errors
    assert not (cupboard.folder / "board0").is_symlink()
