"""Log of a trial: other readers can read it, and it depends on the trial alone."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tactile_tools.plot.reach_series import read_reach

Recorded = Callable[..., tuple[int, Path]]

TYPES = {
    "/world/world/objects": "visualization_msgs/msg/MarkerArray",
    "/arm/arm/state": "tactile_msgs/msg/ArmState",
    "/arm/arm/cmd_vel": "tactile_msgs/msg/ArmCommand",
    "/tactile/finger/features": "tactile_msgs/msg/ContactFeatures",
    "/reach/reach/state": "tactile_msgs/msg/ReachState",
    "/reach/reach/event": "tactile_msgs/msg/ReachEvent",
}


@pytest.mark.parametrize("depth", ["contacts", "taxels"])
def test_mcap_reader_reads_every_message(recorded: Recorded, depth: str) -> None:
    code, path = recorded(depth)
    assert code in (0, 1)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
        summary = reader.get_summary()
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert summary is not None
    types = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert types.items() >= TYPES.items()
    assert ("/tactile/finger/forces" in types) == (depth == "taxels")
    count = Counter(d.channel.topic for d in decoded)
    result = json.loads(metadata["outcome"]["json"])
    # Every control cycle, nothing dropped.
    for topic in ("/reach/reach/state", "/arm/arm/state", "/arm/arm/cmd_vel"):
        assert count[topic] == result["cycles"]
    period = {"contacts": 0.01, "taxels": 0.04}[depth]
    expected = result["cycles"] * 0.01 / period
    assert count["/tactile/finger/features"] == pytest.approx(expected, abs=3)
    assert len(json.loads(attachments["scene.json"])["objects"]) == 12
    assert metadata["trial"] == {"strategy": "hybrid_event", "seed": "0", "scene_seed": "29"}
    states = [d.decoded_message for d in decoded if d.channel.topic == "/arm/arm/state"]
    assert all(b.captured_ns - a.captured_ns == 10_000_000 for a, b in pairwise(states))
    moved = math.dist((states[0].x, states[0].y), (states[-1].x, states[-1].y))
    assert moved > 0.1
    events = [d.decoded_message for d in decoded if d.channel.topic == "/reach/reach/event"]
    ends = [e for e in events if e.kind == "outcome"]
    assert [e.text for e in ends] == [result["outcome"]["text"]]
    assert ends[0].stamped_ns == max(d.decoded_message.stamped_ns for d in decoded
                                     if d.channel.topic == "/reach/reach/state")  # fmt: skip


def test_same_trial_gives_the_same_log(recorded: Recorded) -> None:
    """Message by message, times included: nothing in it comes from a real clock."""
    logs = []
    for again in ("", " again"):
        _, path = recorded("taxels", again)
        with path.open("rb") as file:
            logs.append(
                [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
            )
    assert logs[0] == logs[1]


def test_series_describe_the_reach(recorded: Recorded) -> None:
    code, path = recorded("taxels")
    reach = read_reach(path)
    assert reach.time[0] == 0.0
    assert reach.outcome().code == ("reached" if code == 0 else "timeout")
    tip = reach.tip()
    goal = reach.states[-1].goal
    assert math.dist(tip[-1], (goal.x, goal.y)) == pytest.approx(
        reach.states[-1].distance, abs=2e-3
    )
    moments = reach.moments(5, least_n=0.3)
    assert moments == sorted(moments)
    assert len(moments) >= 2
    for index in moments:
        for contact in reach.contacts_at(index):
            x, y, _ = reach.pose_at(reach.touch_time[index])
            # Contacts are on the finger: 15.8 cm long, 5.7 cm wide.
            assert math.dist(contact.place, (x, y)) < 0.165
            assert contact.normal >= 0.0
