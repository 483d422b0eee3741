"""One reachd per arm (row 35)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from reachd.lock import ArmLock, LockError, runtime_folder


def test_second_process_is_refused_naming_the_first(tmp_path: Path) -> None:
    first, second = ArmLock("arm", tmp_path), ArmLock("arm", tmp_path)
    first.acquire("left")
    with pytest.raises(LockError, match=rf"process {os.getpid()}, user .+, reach 'left'"):
        second.acquire("right")
    ArmLock("other", tmp_path).acquire("right")
    first.release()
    second.acquire("right")


def test_lock_of_a_killed_holder_is_free(tmp_path: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path; from reachd.lock import ArmLock\n"
        "ArmLock('arm', Path(sys.argv[1])).acquire('a'); print('held', flush=True); time.sleep(60)"
    )
    words = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(LockError, match=f"process {holder.pid}"):
            ArmLock("arm", tmp_path).acquire("b")
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    ArmLock("arm", tmp_path).acquire("b")


def test_planted_symlink_is_not_followed(tmp_path: Path) -> None:
    lock = ArmLock("arm", tmp_path)
    victim = tmp_path / "victim"
    victim.write_text("precious")
    lock.path.symlink_to(victim)
    with pytest.raises(LockError, match="cannot open the lock"):
        lock.acquire("a")
    assert victim.read_text() == "precious"


def test_garbled_holder_note_does_not_hide_the_refusal(tmp_path: Path) -> None:
    first = ArmLock("arm", tmp_path)
    first.acquire("a")
    first.note.write_bytes(b"\xff{")
    with pytest.raises(LockError, match=rf"another reachd .process {os.getpid()}, user"):
        ArmLock("arm", tmp_path).acquire("b")


def test_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LockError, match="TACTILE_RUNTIME_DIR"):
        ArmLock("arm", tmp_path / "file").acquire("a")


def test_lock_folder_is_per_user_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TACTILE_RUNTIME_DIR", raising=False)
    assert runtime_folder().parent in (Path("/run/lock"), Path("/tmp"))
    assert runtime_folder().name == f"tactile-reach-{os.geteuid()}"
    monkeypatch.setenv("TACTILE_RUNTIME_DIR", str(tmp_path))
    assert ArmLock("arm").path.parent == tmp_path


def test_file_with_the_name_of_a_lock_keeps_its_contents(tmp_path: Path) -> None:
    lock = ArmLock("arm", tmp_path)
    lock.path.write_text("precious")
    lock.note.symlink_to(tmp_path / "victim")
    (tmp_path / "victim").write_text("precious, too")
    lock.acquire("a")
    assert lock.path.read_text() == "precious"
    assert (tmp_path / "victim").read_text() == "precious, too"
    lock.release()


def test_hard_link_is_not_accepted_as_a_lock(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    lock = ArmLock("arm", tmp_path)
    os.link(victim, lock.path)
    before = victim.stat()
    with pytest.raises(LockError, match="it has a second name"):
        lock.acquire("a")
    assert victim.read_text() == "precious"
    assert victim.stat().st_mode == before.st_mode


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_special_file_is_refused_without_waiting(tmp_path: Path, kind: str) -> None:
    lock = ArmLock("arm", tmp_path)
    if kind == "fifo":
        os.mkfifo(lock.path)
    else:
        lock.path.mkdir()
    with pytest.raises(LockError, match="it is not a plain file"):
        lock.acquire("a")


@pytest.mark.skipif(os.geteuid() != 0, reason="needs a second user")
def test_lock_of_another_user_is_refused_naming_its_holder(tmp_path: Path) -> None:
    lock = ArmLock("arm", tmp_path)
    script = (
        "import fcntl, os, sys, time; os.setuid(65534)\n"
        "f = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT, 0o666); fcntl.flock(f, fcntl.LOCK_EX)\n"
        'os.write(f, b\'{"pid": 1, "reach": "x\\\\u001b[2J"}\')\n'
        "print('held', flush=True); time.sleep(60)"
    )
    tmp_path.chmod(0o777)
    for parent in tmp_path.parents[:3]:
        parent.chmod(0o755)
    words = [sys.executable, "-c", script, str(lock.path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(LockError, match=r"belongs to user \w+") as caught:
            lock.acquire("a")
        holder.kill()
    if Path("/proc/locks").exists():
        assert f"process {holder.pid}, user nobody" in str(caught.value)
    assert "\x1b" not in str(caught.value)


def test_holder_text_is_escaped_for_the_terminal(tmp_path: Path) -> None:
    first = ArmLock("arm", tmp_path)
    first.acquire("x\x1b[2J" + "y" * 500)
    with pytest.raises(LockError) as caught:
        ArmLock("arm", tmp_path).acquire("b")
    assert "\x1b" not in str(caught.value)
    assert len(str(caught.value)) < 250
