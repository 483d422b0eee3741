"""The page's server as a process: values, refusals, slow and many viewers, requests, logs."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus

import tactile_reach as tr
from tactile_tools.cli import main
from tests.support.waiting import PATIENCE_S


def fetch(address: str, **headers: str) -> tuple[int, bytes, Any]:
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as reply:
            return reply.status, reply.read(), reply.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def test_frames_are_what_is_on_the_bus(rig: Any, viewer: Any, streaming: Any) -> None:
    page = viewer(rig.page())
    with tr.connect(rig.endpoint, find_s=PATIENCE_S) as bus:
        stream = bus.board("pad").features(queue=5000, timeout_s=PATIENCE_S)
        page.frame(streaming)
        shown = [page.frame(streaming)["boards"]["pad"]["force"] for _ in range(5)]
        heard = {}
        while shown[-1]["seq"] not in heard:
            f = next(stream)
            heard[f.sequence] = f
    matched = [force for force in shown if force["seq"] in heard]
    assert len(matched) >= 3
    for force in matched:
        assert force["normal"] == pytest.approx(heard[force["seq"]].normal_force, abs=1e-4)
        assert force["contact"] == heard[force["seq"]].taxels_in_contact
    assert [len(a["xy"]) for a in page.layout["boards"]["pad"]["arrays"]] == [5]


def test_files_are_served_with_a_strict_policy_and_nothing_else_is(rig: Any) -> None:
    address = rig.page()
    status, body, headers = fetch(address)
    assert status == 200
    assert b"<title>tactile</title>" in body
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert b"http" not in body.replace(b"http-equiv", b""), "the page works offline"
    for name in ("page.css", "page.js", "skin.js", "chart.js", "cupboard.js", "icon.svg"):
        assert fetch(address + name)[0] == 200, name
    for path in ("x", "../cli.py", "%2e%2e/cli.py", "page/index.html"):
        assert fetch(address + path)[0] == 404, path
    assert fetch(address, Host="evil.example")[0] == 403
    assert fetch(address + "live", Origin="http://evil.example")[0] == 403


def test_page_of_another_site_gets_no_stream(rig: Any, viewer: Any) -> None:
    with pytest.raises(InvalidStatus) as refused:
        viewer(rig.page(), additional_headers={"Origin": "http://evil.example"})
    assert refused.value.response.status_code == 403


def test_beyond_loopback_a_token_is_needed(rig: Any, viewer: Any) -> None:
    address = rig.page("--bind", "0.0.0.0", "--token", "0123456789abcdef0123")
    port = address.partition("?")[0].rstrip("/").rpartition(":")[2]
    here = f"http://127.0.0.1:{port}/"
    assert "token=0123456789abcdef0123" in address
    assert fetch(here)[0] == 403
    with pytest.raises(InvalidStatus):
        viewer(here)

    class Stay(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, *_: Any) -> None:
            return None

    with pytest.raises(urllib.error.HTTPError) as moved:
        urllib.request.build_opener(Stay).open(here + "?token=0123456789abcdef0123")
    assert moved.value.code == 303
    cookie = moved.value.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    known = cookie.partition(";")[0]
    assert fetch(here, Cookie=known)[0] == 200
    assert viewer(here, additional_headers={"Cookie": known}).next()["hello"]


def more_frames(page: Any) -> bool:
    """Whether a frame waits to be read."""
    try:
        while "frame" not in page.next(0.2):
            pass
    except TimeoutError:
        return False
    return True


def test_a_viewer_that_draws_nothing_holds_up_nobody_and_gets_no_old_frames(
    rig: Any, viewer: Any, streaming: Any
) -> None:
    address = rig.page()
    slow, quick = viewer(address), viewer(address)
    slow.draws = False
    quick.frame(streaming)
    numbers = [quick.frame()["n"] for _ in range(20)]
    assert numbers == sorted(set(numbers))
    got = [slow.frame()["n"] for _ in range(2)]
    for _ in range(20):
        quick.frame()
    assert not more_frames(slow), "no more than two frames wait for it"
    slow.draws = True
    slow.send(ack=got[-1])
    newest = quick.frame()["n"]
    assert slow.frame()["n"] >= newest - 5 > got[-1]


def test_nonsense_from_a_viewer_is_answered_and_harms_nobody(rig: Any, viewer: Any) -> None:
    page = viewer(rig.page())
    page.socket.send("{")
    page.socket.send(b"\xff\x00")
    page.socket.send('{"do": "reboot"}')
    page.send(ack=10**30)
    ok, text = page.ask(do="tare", board="nobody")
    assert not ok
    assert "no such board: 'nobody' (available: pad)" in text
    ok, text = page.ask(do="seek", share=0.5)
    assert not ok
    assert page.frame()


def test_tare_record_and_rate_by_the_page(rig: Any, viewer: Any, streaming: Any) -> None:
    page = viewer(rig.page())
    page.frame(streaming)
    ok, text = page.ask(do="tare", board="pad", force=True)
    assert ok, text
    ok, text = page.ask(do="record", board="pad", name="press-1")
    assert ok, text
    page.frame(lambda f: f["boards"]["pad"]["recording"] is not None)
    ok, text = page.ask(do="record", board="pad", name="press-2")
    assert not ok
    assert "already recording" in text
    ok, text = page.ask(do="stop_record", board="pad")
    assert ok, text
    log = tr.read_log(rig.folder / "logs" / "press-1.mcap")
    assert log.closed
    assert len(log["/tactile/pad/features"].time_s) > 0
    ok, text = page.ask(do="rate", board="pad", rate_hz=50.0)
    assert not ok
    assert "takes no commands" in text


def test_read_only_page_sends_no_requests(rig: Any, viewer: Any, streaming: Any) -> None:
    page = viewer(rig.page("--read-only"))
    page.frame(streaming)
    assert page.hello["read_only"]
    assert page.ask(do="tare", board="pad") == (False, "this page only looks on (--read-only)")


def test_page_follows_unplugging_and_restarts(
    make_rig: Callable[[], Any], viewer: Any, streaming: Any
) -> None:
    rig = make_rig()
    page = viewer(rig.page())
    page.frame(streaming)

    def state(*words: str) -> Callable[[dict[str, Any]], bool]:
        return lambda frame: frame["boards"]["pad"]["state"] in words

    rig.board.end()
    told = page.frame(state("unplugged", "silent"))["boards"]["pad"]
    assert not told["valid"]
    assert told["reasons"]
    rig.start_board()
    page.frame(streaming)
    rig.daemon.end()
    told = page.frame(state("gone"))["boards"]["pad"]
    assert told["reasons"] == ["tactiled has stopped: start it again"]
    rig.start_daemon()
    page.frame(streaming)


def test_a_log_is_played_sought_and_paused(
    rig: Any, viewer: Any, streaming: Any, until: Any, recording_of: Any
) -> None:
    with tr.connect(rig.endpoint, find_s=PATIENCE_S) as bus:
        board = bus.board("pad")
        board.newest(PATIENCE_S)
        board.start_recording("to-play")
        until(lambda: recording_of(board)["messages"] > 1000)
        board.stop_recording()
    log = rig.folder / "logs" / "to-play.mcap"
    page = viewer(rig.page(str(log)))
    first = page.frame(streaming)
    assert first["log"]["file"].endswith("to-play.mcap")
    assert page.layout["boards"]["pad"]["taxels"] == 5
    assert page.ask(do="pause")[0]
    assert page.ask(do="seek", share=0.6)[0]
    frame = page.frame(lambda f: abs(f["log"]["share"] - 0.6) < 0.01 and streaming(f))
    table = tr.read_log(log).board("pad")["features"]
    row = table["sequence"].tolist().index(frame["boards"]["pad"]["force"]["seq"])
    assert frame["boards"]["pad"]["force"]["normal"] == pytest.approx(
        table["normal_force"][row], abs=1e-4
    )
    assert table.time_s[row] == pytest.approx(frame["log"]["at_s"], abs=0.5)
    assert not page.ask(do="tare", board="pad")[0]
    assert page.ask(do="play", speed=8.0)[0]
    page.frame(lambda f: f["log"]["share"] == 1.0)
    assert not page.ask(do="play", speed=-3.0)[0]


def test_the_page_of_a_daemon_ends_with_it_also_when_that_is_killed(
    make_rig: Callable[[], Any], viewer: Any, streaming: Any, until: Any
) -> None:
    rig = make_rig()
    rig.daemon.end()
    rig.daemon = rig.start_daemon("--view", "0")
    until(lambda: "http://" in rig.daemon.said)
    address = next(w for w in rig.daemon.said.split() if w.startswith("http://"))
    viewer(address).frame(streaming)
    rig.daemon.end()

    def gone() -> bool:
        try:
            fetch(address)
        except OSError:
            return True
        return False

    until(gone)


def test_bad_arguments_are_one_sentence_with_the_remedy(
    rig: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = rig.page().rstrip("/").rpartition(":")[2]
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    for words, code, said in (
        (["--port", port, "--connect", rig.endpoint], 3, "is in use"),
        ([str(empty)], 2, "empty.mcap"),
        ([str(tmp_path / "none.mcap")], 2, "does not exist"),
        (["--token", "short"], 2, "at least 16"),
    ):
        assert main(["view", *words]) == code
        text = capsys.readouterr().err
        assert said in text
        assert text.count("\n") == 1
        assert "Traceback" not in text
