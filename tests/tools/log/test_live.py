"""Logs of real daemons: reprocessed bit for bit, replayed on the bus, read by other readers."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mcap_ros2.decoder
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import Tap
from tactile_core.bus.topics import service_key
from tactile_core.log.info import info
from tactile_tools.processes import running, wait_for
from tests.support.network import free_port
from tests.support.paths import ROOT
from tests.support.processes import command
from tests.support.tactiled_lab import CALM_HZ
from tests.support.waiting import PATIENCE_S, wait_until

PRESS = """[[press]]
array = "left"
u_mm = 8.0
v_mm = 8.0
normal_n = 4.0
shear_n = [-1.5, 0.0]
radius_mm = 8.0
start_s = 2.0
ramp_s = 0.3
hold_s = 30.0
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of tactiled on a finger and an AnySkin board.

    ``run.mcap``, and ``cut.mcap``: a copy made meanwhile, like what a `kill -9` leaves.
    """
    folder = tmp_path_factory.mktemp("lab")
    (folder / "press.toml").write_text(PRESS)
    simdevice, tactiled = command("simdevice"), command("tactiled")
    subprocess.run(
        [simdevice, "calibration", "--seed", "1", "--out", str(folder / "b.cal.toml")],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    b, s, endpoint = folder / "b", folder / "s", f"tcp/127.0.0.1:{free_port()}"
    boards = [simdevice, "boards", "--seed", "1", "--rate", CALM_HZ]
    press = ["--press", str(folder / "press.toml"), "--rotate", "90deg/10s"]
    with (
        running([*boards, "--pty", str(b), *press], folder / "b.txt") as first,
        running([*boards, "--pty", str(s), "--board", "anyskin"], folder / "s.txt") as second,
    ):
        wait_until(lambda: (b.exists() and s.exists()) or first.poll() or second.poll())
        wait_for(b, first, folder / "b.txt")
        wait_for(s, second, folder / "s.txt")
        words = [
            *(tactiled, "--port", str(b), "--name", "finger", "--port", str(s), "--name", "skin"),
            *("--calibration", str(folder / "b.cal.toml"), "--log", str(folder / "run.mcap")),
            *("--listen", endpoint),
        ]
        with running(words, folder / "t.txt") as daemon:
            _disturb(folder, endpoint, daemon)
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(PATIENCE_S)
    assert daemon.returncode == 0, (folder / "t.txt").read_text()
    return folder


def _disturb(folder: Path, endpoint: str, daemon: subprocess.Popen[bytes]) -> None:
    """Tare one board, stop the daemon for a while, and copy the log as it stands."""
    session = open_session(BusConfig(listen=(), connect=(endpoint,)))
    heard = {"finger": 0, "skin": 0}

    def count(sample: Any) -> None:
        heard[sample.key.split("/")[1]] += 1

    tap = Tap(session, "tactile/*/features", count)
    try:
        wait_until(lambda: min(heard.values()) > 100)
        with contextlib.suppress(ServiceError):  # on a busy machine the field may seem to move
            call(session, service_key("skin", "tare"), {}, timeout=PATIENCE_S)
        daemon.send_signal(signal.SIGSTOP)
        time.sleep(0.9)
        daemon.send_signal(signal.SIGCONT)
        before = dict(heard)
        wait_until(lambda: all(heard[name] > before[name] + 50 for name in heard))
        shutil.copy(folder / "run.mcap", folder / "cut.mcap")
        wait_until(lambda: all(heard[name] > before[name] + 80 for name in heard))
    finally:
        tap.close()
        close_session(session)


def test_features_of_real_daemons_are_reproduced_bit_for_bit(lab: Path, log_tool: Any) -> None:
    outcome = log_tool("reprocess", lab / "run.mcap", "--out", lab / "again.mcap")
    assert outcome.code == 0, outcome.err
    assert "estimated anew" not in outcome.out
    rows = re.findall(
        r"^(\S+): (\d+) messages, (\d+) in the log; (\d+) bit for bit the same", outcome.out, re.M
    )
    assert len(rows) == 10
    for topic, new, old, same in rows:
        assert int(new) == int(old) == int(same) > 10, (topic, outcome.out)


def test_log_of_a_killed_daemon_is_reproduced_bit_for_bit(lab: Path, log_tool: Any) -> None:
    outcome = log_tool("reprocess", lab / "cut.mcap", "--out", lab / "cut-again.mcap")
    assert outcome.code == 0, outcome.err
    rows = re.findall(
        r"^(\S+): (\d+) messages, (\d+) in the log; (\d+) bit for bit the same", outcome.out, re.M
    )
    assert len(rows) == 10
    for topic, _, old, same in rows:
        # The raw bytes of the last few cycles were to be logged next.
        assert int(old) - 100 <= int(same), (topic, outcome.out)
        assert int(same) > 5


def test_doctor_accepts_the_log_and_rejects_the_truncated_one(lab: Path, log_tool: Any) -> None:
    sound = log_tool("doctor", lab / "run.mcap")
    assert "not closed" not in sound.out
    assert "unknown_schema" not in log_tool("doctor", lab / "run.mcap", "--json").out
    cut = log_tool("doctor", lab / "cut.mcap")
    assert cut.code == 1
    assert f"tactile log recover {lab / 'cut.mcap'}" in cut.out


def test_replay_uses_its_own_keys_and_original_spacing(lab: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = open_session(BusConfig(listen=(endpoint,), connect=()))
    heard: list[tuple[float, str]] = []
    tap = Tap(session, "**", lambda sample: heard.append((time.monotonic(), sample.key)))
    words = ["log", "replay", str(lab / "run.mcap"), "--topic", "*/features", "--loop"]
    try:
        with running(
            [command("tactile"), *words, "--speed", "4", "--connect", endpoint], tmp_path / "r.txt"
        ) as player:
            wait_until(lambda: len(heard) > 2000)
            os.kill(player.pid, signal.SIGINT)
            assert player.wait(PATIENCE_S) == 0
    finally:
        tap.close()
        close_session(session)
    said = (tmp_path / "r.txt").read_text()
    assert "stopped" in said
    assert "Traceback" not in said
    assert {key for _, key in heard} == {
        "replay/tactile/finger/features", "replay/tactile/skin/features"
    }  # fmt: skip
    # Two boards of 100 Hz at four times their speed; a busy machine may be slower, never faster.
    assert len(heard) / (heard[-1][0] - heard[0][0]) < 1200


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a complete reach with taxels, in lockstep."""
    path = tmp_path_factory.mktemp("trial") / "trial.mcap"
    words = ["reach", "--headless", "--strategy", "straight", "--seed", "4", "--log", str(path)]
    done = subprocess.run([command("tactile"), *words], capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    return path


@pytest.fixture(params=["trial", "lab"])
def any_log(request: pytest.FixtureRequest) -> Path:
    found: Path = request.getfixturevalue(request.param)
    return found / "run.mcap" if found.is_dir() else found


def test_mcap_reads_and_decodes_every_message_of_every_channel(any_log: Path) -> None:
    expected = {channel.topic: channel.messages for channel in info(any_log).channels}
    counts: dict[str, int] = {}
    with any_log.open("rb") as file:
        factories = [mcap_ros2.decoder.DecoderFactory()]
        reader = make_reader(file, validate_crcs=True, decoder_factories=factories)
        assert reader.get_header().profile == "ros2"
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert schema is not None
            assert message is not None
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    assert counts == expected


def test_rosbags_reads_the_exported_folder(any_log: Path, log_tool: Any, tmp_path: Path) -> None:
    outcome = log_tool("rosbag", any_log, "--out", tmp_path / "bag")
    assert outcome.code == 0, outcome.err
    store = get_typestore(Stores.ROS2_HUMBLE)
    expected = {channel.topic: channel.messages for channel in info(any_log).channels}
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == sum(expected.values())
        assert {c.topic: c.msgcount for c in reader.connections} == expected
        for connection in reader.connections:
            types = get_types_from_msg(connection.msgdef.data, connection.msgtype)
            store.register({k: v for k, v in types.items() if k not in store.fielddefs})
        counts: dict[str, int] = {}
        for connection, _, data in reader.messages():
            store.deserialize_cdr(data, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts == {topic: count for topic, count in expected.items() if count}


def test_log_contains_what_a_3d_view_needs(trial: Path) -> None:
    seen: dict[str, set[str]] = {}
    frames = set()
    with trial.open("rb") as file:
        reader = make_reader(file, decoder_factories=[mcap_ros2.decoder.DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            if schema is not None and schema.name == "visualization_msgs/msg/MarkerArray":
                for marker in message.markers:
                    seen.setdefault(channel.topic, set()).add(marker.ns)
                    assert marker.header.frame_id in ("cupboard", "ee")
            elif schema is not None and schema.name == "tf2_msgs/msg/TFMessage":
                frames |= {(t.header.frame_id, t.child_frame_id) for t in message.transforms}
    assert seen["/world/world/objects"] >= {"objects", "cupboard", "finger", "goal"}
    assert seen["/tactile/finger/contacts"] >= {"contacts", "forces", "labels"}
    assert frames == {("cupboard", "ee")}


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = threading.active_count()
    yield
    wait_until(lambda: threading.active_count() <= before + 2)


def test_foxglove_layout_names_topics_of_the_log(trial: Path, lab: Path) -> None:
    layout = json.loads((ROOT / "docs" / "foxglove-layout.json").read_text())
    panels = layout["configById"]
    placed = set(re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(panels)))
    assert placed | {layout["layout"]} == set(panels)
    topics: dict[str, str] = {}
    for path in (trial, lab / "run.mcap"):
        topics |= {channel.topic: channel.msgtype for channel in info(path).channels}
    named = {t for panel in panels.values() for t in panel.get("topics", {})}
    named |= {p["topicToRender"] for p in panels.values() if "topicToRender" in p}
    assert named <= set(topics)
    for panel in panels.values():
        for each in panel.get("paths", []):
            topic, _, field = each["value"].partition(".")
            msgtype = topics[topic]
            for part in re.sub(r"\[\d+\]", "", field).split("."):
                fields = dict(codec().fields(msgtype))
                assert part in fields, each
                kind, arguments = fields[part]
                msgtype = arguments if kind == 2 else ""  # rosbags: a field of another type
