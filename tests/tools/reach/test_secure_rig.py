"""Stranger beside a whole rig of real processes: over TLS, over loopback TCP, at its sockets."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.runtime import RUNTIME_VARIABLE
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import ATTACHMENT, Tap
from tactile_core.bus.topics import ARM_STATE, COMMAND, FEATURES, service_key
from tactile_tools.cli import main
from tactile_tools.reach.process_rig import is_moving
from tests.support.network import free_port
from tests.support.reachd_lab import patient_config
from tests.support.waiting import PATIENCE_S, wait_until


@dataclass
class Rig:
    """Cupboard, tactiled and reachd. ``operator``: a session with all rights of a person."""

    folder: Path
    places: dict[str, str]
    flags: dict[str, list[str]]
    states: list[Any] = field(default_factory=list)
    features: list[Any] = field(default_factory=list)
    operator: Any = None

    def ask(self, service: str, request: object = None, kind: str = "reach") -> Any:
        name = {"reach": "reach", "arm": "arm", "world": "world"}[kind]
        return call(self.operator, service_key(name, service, kind), request, PATIENCE_S)

    def until(self, done: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
        wait_until(done, timeout_s, self.output)

    def output(self) -> list[str]:
        return [p.read_text(errors="replace")[-500:] for p in self.folder.glob("*.txt")]


ROLES = ("cupboard", "tactiled", "reachd")


@contextlib.contextmanager
def running_rig(folder: Path, places: dict[str, str], keys: Path | None = None) -> Iterator[Rig]:
    flags: dict[str, list[str]] = {}
    party = {"cupboard": "arm", "tactiled": "tactiled", "reachd": "reachd"}
    seek = {"cupboard": ["tactiled"], "tactiled": ["cupboard"], "reachd": ["cupboard", "tactiled"]}
    for name in ROLES:
        flags[name] = ["--listen", places[name]] if places else []
        for other in seek[name] if places else []:
            flags[name] += ["--connect", places[other]]
        flags[name] += ["--keys", str(keys / party[name])] if keys is not None else []
    rig = Rig(folder, places, flags)
    words = {
        "cupboard": [
            "sim_device", "cupboard", "--scene", "authors_sim", "--seed", "3", "--pty", "board0",
            "--rate", "50", "--engine", "planar",
        ],
        "tactiled": ["tactiled.cli", "--port", "board0", "--no-log", "--wait"],
        "reachd": [
            "reachd", "--serve", "--strategy", "straight", "--no-log", *patient_config(folder),
        ],
    }  # fmt: skip
    with contextlib.ExitStack() as stack:
        for name in ROLES:
            output = stack.enter_context((folder / f"{name}.txt").open("wb"))
            process = subprocess.Popen(
                [sys.executable, "-m", *words[name], *flags[name]],
                stdout=output, stderr=subprocess.STDOUT, cwd=folder,
                env=os.environ | {"COLUMNS": "200"},
            )  # fmt: skip
            stack.callback(_end, process)
            if name == "cupboard":
                rig.until((folder / "board0").exists)
        rig.operator = open_session(
            BusConfig(
                listen=(),
                connect=tuple(places.values()) if places else None,
                keys=None if keys is None else str(keys / "operator"),
            )
        )
        stack.callback(close_session, rig.operator)
        for topic, name, into in (
            (ARM_STATE, "arm", rig.states),
            (FEATURES, "board0", rig.features),
        ):
            tap = Tap(
                rig.operator,
                topic.key(name),
                lambda s, t=topic, i=into: i.append(codec().decode(t, s.data)),
            )
            stack.callback(tap.close)
        rig.until(lambda: rig.states and rig.features and rig.features[-1].valid)
        yield rig


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(120)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def reaches(rig: Rig) -> None:
    """The operator arms, gives a goal, and the arm moves; then it is told to stop.

    Again, where a starved machine held it before it moved.
    """

    def moved() -> bool:
        try:
            at_rest(rig)
            goal = rig.ask("reset", {}, "world")["goal"]  # what held it may press on the finger
            rig.ask("arm")
            rig.states.clear()
            rig.ask("goal", {"x": goal[0], "y": goal[1]})
        except ServiceError:
            return False
        rig.until(lambda: any_moves(rig) or rig.ask("status")["state"] not in UNDER_WAY)
        return any_moves(rig)

    rig.until(moved)
    at_rest(rig)


UNDER_WAY = ("homing", "reaching")


def at_rest(rig: Rig) -> None:
    """End the reach, if there is one, and wait until the arm stands and another may begin."""
    for request in ("stop", "reset"):
        with contextlib.suppress(ServiceError):  # nothing to stop, or to reset
            rig.ask(request)
    rig.until(lambda: not is_moving(rig.states[-1].twist, 1e-3))
    rig.until(lambda: rig.ask("status")["state"] == "idle")


def any_moves(rig: Rig) -> bool:
    return any(is_moving(state.twist, 1e-3) for state in list(rig.states))


def attack(rig: Rig, stranger: zenoh.Session) -> list[Any]:
    """Send commands, limits, clear, arm, goal and tare without rights. Returns the answers.

    Meanwhile the arm must not move at all, nor its limits change.
    """
    before = rig.states[-1]
    rig.states.clear()
    key = COMMAND.key("arm")
    for number in range(150):
        wall = time.time_ns()
        twist = MSG.Twist(MSG.Vector3(-0.3, 0.0, 0.0), MSG.Vector3(0.0, 0.0, 0.0))
        command = MSG.ArmCommand(
            header(wall, "cupboard"), twist, time.monotonic_ns(), 2**40 + number, 0.05,
            before.commander, np.zeros(16, np.uint8),
        )  # fmt: skip
        data = codec().encode(COMMAND, command)
        stranger.put(key, data, attachment=ATTACHMENT.pack(2**40 + number, wall, 16, b"E" * 16))
        time.sleep(0.005)
    asked = (
        (service_key("arm", "limits", "arm"), {"v_max": 0.5, "f_max": 100.0}),
        (service_key("arm", "clear", "arm"), {}),
        (service_key("world", "reset", "world"), {}),
        (service_key("reach", "arm", "reach"), {}),
        (service_key("reach", "goal", "reach"), {"x": 0.3, "y": 0.0}),
        (service_key("board0", "tare"), {}),
        (service_key("board0", "set_rate"), {"rate_hz": 0.001}),
    )
    answers = [
        reply.ok or reply.err
        for name, request in asked
        for reply in stranger.get(name, payload=json.dumps(request).encode(), timeout=0.3)
    ]
    rig.until(lambda: len(rig.states) > 20)
    for state in list(rig.states):
        assert not is_moving(state.twist, 1e-3)
        assert (state.v_max, state.f_max) == (before.v_max, before.f_max)
    return answers


def raw(endpoint: str, **settings: Any) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer", "listen/endpoints": [], "connect/endpoints": [endpoint],
        "connect/timeout_ms": -1, "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False, "scouting/gossip/enabled": False,
        "scouting/delay": 0, **settings,
    }.items():  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def test_stranger_over_plain_tcp_moves_nothing_and_blocks_nobody(tmp_path: Path) -> None:
    places = {name: f"tcp/127.0.0.1:{free_port()}" for name in ROLES}
    with running_rig(tmp_path, places) as rig:
        for place in (places["cupboard"], places["reachd"]):
            stranger = raw(place)
            try:
                assert attack(rig, stranger) == []
            finally:
                close_session(stranger)
        reaches(rig)


def test_tls_roles_have_only_their_rights_and_viewer_only_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("cryptography", reason="making keys needs cryptography")
    lab = tmp_path / "lab"
    assert main(["bus", "keys", str(lab)]) == 0
    places = {name: f"tls/localhost:{free_port()}" for name in ROLES}
    with running_rig(tmp_path, places, lab) as rig:
        viewer = open_session(
            BusConfig(listen=(), connect=tuple(places.values()), keys=str(lab / "viewer"))
        )
        heard: list[Any] = []
        tap = Tap(viewer, ARM_STATE.key("arm"), heard.append)
        try:
            rig.until(lambda: heard)
            assert attack(rig, viewer) == []
            assert call(viewer, service_key("reach", "status", "reach"), timeout=PATIENCE_S)
        finally:
            tap.close()
            close_session(viewer)
        reaches(rig)
        connect = [word for place in places.values() for word in ("--connect", place)]
        capsys.readouterr()
        words = ["health", "--keys", str(lab / "viewer"), *connect, "--timeout", "10"]
        rig.until(lambda: main([*words, "--board", "board0", "--reach", "reach"]) in (0, 1))
        assert "board board0" in capsys.readouterr().out


def test_default_rigs_meet_in_separate_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without any option; a socket's path is short, so the folder is one of the system's."""
    with contextlib.ExitStack() as stack:
        rigs = []
        for name in ("one", "two"):
            place = stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-"))
            monkeypatch.setenv(RUNTIME_VARIABLE, place)
            (tmp_path / name).mkdir()
            rigs.append(stack.enter_context(running_rig(tmp_path / name, {})))
        reaches(rigs[1])
        assert not any(is_moving(s.twist, 1e-3) for s in rigs[0].states)
