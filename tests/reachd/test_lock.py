"""One reachd an arm (row 35)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from reachd.lock import ArmLock, LockError, runtime_folder


def test_the_second_is_refused_by_the_name_of_the_first(tmp_path: Path) -> None:
    first, second = ArmLock("arm", tmp_path), ArmLock("arm", tmp_path)
    first.acquire("left")
    with pytest.raises(LockError, match=rf"process {os.getpid()}, reach 'left'"):
        second.acquire("right")
    ArmLock("other", tmp_path).acquire("right")
    first.release()
    second.acquire("right")


def test_the_lock_of_a_killed_holder_is_free(tmp_path: Path) -> None:
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


def test_a_link_that_someone_laid_is_not_followed(tmp_path: Path) -> None:
    lock = ArmLock("arm", tmp_path)
    victim = tmp_path / "victim"
    victim.write_text("precious")
    lock.path.symlink_to(victim)
    with pytest.raises(LockError, match="cannot open the lock"):
        lock.acquire("a")
    assert victim.read_text() == "precious"


def test_a_holder_s_note_that_is_garbage_does_not_hide_the_refusal(tmp_path: Path) -> None:
    first = ArmLock("arm", tmp_path)
    first.acquire("a")
    first.path.write_bytes(b"\xff{")
    with pytest.raises(LockError, match="commanded by another reachd: stop"):
        ArmLock("arm", tmp_path).acquire("b")


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(LockError, match="TACTILE_RUNTIME_DIR"):
        ArmLock("arm", tmp_path / "nowhere").acquire("a")


def test_all_users_share_one_folder_unless_another_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TACTILE_RUNTIME_DIR", raising=False)
    assert runtime_folder() in (Path("/run/lock"), Path("/tmp"))
    monkeypatch.setenv("TACTILE_RUNTIME_DIR", str(tmp_path))
    assert ArmLock("arm").path.parent == tmp_path
