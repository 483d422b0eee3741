"""Folder of an experiment: its definition, and finished trials as they finish.

``experiment.json`` holds the definition. ``trials.jsonl`` holds one line per finished trial,
written in one piece. If the process is killed in between, at most its last line is torn, and that
trial runs again.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from tactile_tools.experiments.rows import Row, replace_file, whole
from tactile_tools.experiments.spec import TrialSpec, spec_of

FORMAT = 1
"""Version of the folder's files; any other is refused."""

FLUSH_S = 1.0
"""Longest time, s, from a trial's end until it is safe from a loss of power. A kill loses
nothing."""


class FolderError(Exception):
    """A folder cannot be used; the message says which, why and what to do."""


class DiskError(Exception):
    """Something could not be written; the message says what, why, what was kept and what to do."""


class Journal:
    """Folder of one run, locked so that no other process writes to it. A context manager.

    ``definition``: what is to be run, as plain JSON values. It may equal the folder's own or
    contain all of its trials and more. Raises FolderError if the folder belongs to another
    experiment, is not an experiment's or is in use; and DiskError.
    """

    def __init__(self, directory: Path, definition: Mapping[str, Any]) -> None:
        self.directory = directory
        self._lines = directory / "trials.jsonl"
        self._lock: int | None = None
        self._stream: int | None = None
        self._flushed = 0.0
        self.damaged = 0
        wanted = {"format": FORMAT, **definition}
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._lock_folder()
            path = directory / "experiment.json"
            if not path.exists():
                _refuse_other_files(directory)
            elif not _extends(directory, read_definition(directory), wanted):
                return
            replace_file(path, (json.dumps(wanted, indent=1) + "\n").encode())
        except OSError as error:
            self.close()
            raise disk_error(directory, error) from error
        except FolderError:
            self.close()
            raise

    def __enter__(self) -> Journal:
        """Return itself, ready to be written to."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Release the folder."""
        self.close()

    def load(self) -> dict[TrialSpec, Row]:
        """Return the finished trials and open the file for more; DiskError.

        ``damaged`` then counts the lines that were not trials; those trials run again.
        """
        try:
            data = self._lines.read_bytes() if self._lines.exists() else b""
            finished, self.damaged = parse_lines(data)
            if self.damaged:
                kept = b"".join(_line(row) for row in finished.values())
                replace_file(self._lines, kept)
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
            self._stream = os.open(self._lines, flags, 0o644)
        except OSError as error:
            raise disk_error(self.directory, error) from error
        return finished

    def append(self, row: Row) -> None:
        """Keep ``row``; DiskError, after which the file is as it was before."""
        if self._stream is None:
            raise RuntimeError("load the journal before adding to it")
        try:
            _write_whole(self._stream, _line(row))
            now = time.monotonic()
            if now - self._flushed > FLUSH_S:
                os.fdatasync(self._stream)
                self._flushed = now
        except OSError as error:
            raise disk_error(self.directory, error) from error

    def close(self) -> None:
        """Release the folder; what was added stays."""
        for descriptor in (self._stream, self._lock):
            if descriptor is not None:
                os.close(descriptor)
        self._stream = self._lock = None

    def _lock_folder(self) -> None:
        """Take the lock. The system releases it when the process ends, however it ends."""
        self._lock = os.open(
            self.directory / ".lock", os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644
        )
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderError(
                f"another run is writing to {self.directory}: wait for it, or choose another --out"
            ) from None


def read_definition(directory: Path) -> dict[str, Any]:
    """Definition of the experiment in ``directory``; FolderError."""
    path = directory / "experiment.json"
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FolderError(
            f"{directory} is not a folder of an experiment: cannot read {path.name} ({error})"
        ) from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        found = raw.get("format") if isinstance(raw, dict) else type(raw).__name__
        raise FolderError(
            f"{directory} is an experiment in format {found!r}; this version reads {FORMAT}: "
            "choose another folder"
        )
    return raw


def read_lines(directory: Path) -> dict[TrialSpec, Row]:
    """Finished trials of a run, which may still be going on; FolderError."""
    path = directory / "trials.jsonl"
    try:
        return parse_lines(path.read_bytes())[0]
    except OSError as error:
        raise FolderError(f"cannot read {path}: {error.strerror}") from None


def parse_lines(data: bytes) -> tuple[dict[TrialSpec, Row], int]:
    """Finished trials in ``data``, and the number of lines that are not trials."""
    finished: dict[TrialSpec, Row] = {}
    damaged = 0
    for line in data.splitlines(keepends=True):
        try:
            row = json.loads(line) if line.endswith(b"\n") else None
        except ValueError:
            row = None
        if isinstance(row, dict) and whole(row):
            finished[spec_of(row)] = row
        else:
            damaged += 1
    return finished, damaged


def disk_error(directory: Path, error: OSError) -> DiskError:
    """Error for the user about ``error`` in ``directory``."""
    kept = "finished trials are kept, and the same command runs the rest"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskError(f"the disk of {directory} is full: make room; {kept}")
    return DiskError(f"cannot write to {directory}: {error.strerror}; {kept}")


def _line(row: Row) -> bytes:
    return json.dumps(row, separators=(",", ":")).encode() + b"\n"


def _write_whole(stream: int, line: bytes) -> None:
    """Write ``line`` whole; if the disk is full, leave nothing of it."""
    written = os.write(stream, line)
    if written == len(line):
        return
    size = os.fstat(stream).st_size
    os.ftruncate(stream, size - written)
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _extends(directory: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Whether ``wanted`` extends ``found``; FolderError names what differs otherwise."""
    # Through JSON, as a tuple comes back as a list.
    wanted = json.loads(json.dumps(wanted))
    names = [n for n in dict.fromkeys([*found, *wanted]) if found.get(n) != wanted.get(n)]
    others = [n for n in names if not _is_more(n, found.get(n), wanted.get(n))]
    if others:
        differences = "; ".join(
            f"{n} is {_short(found.get(n))} there and {_short(wanted.get(n))} here" for n in others
        )
        raise FolderError(
            f"{directory} holds another experiment ({differences}): choose another --out, "
            "or give the same options to resume it, or more scenes, strategies and the like"
        )
    return bool(names)


def _is_more(name: str, found: object, wanted: object) -> bool:
    """Whether a study with ``wanted`` has every trial of one with ``found``, and more."""
    if name == "scenes":  # they are numbered from the same seed on
        return isinstance(found, int) and isinstance(wanted, int) and found < wanted
    return (
        isinstance(found, list)
        and isinstance(wanted, list)
        and all(value in wanted for value in found)
    )


def _refuse_other_files(directory: Path) -> None:
    """Raise FolderError if the folder has files of others."""
    # A run that was killed at its very start leaves these.
    ours = {".lock", "experiment.json.part"}
    others = sorted(p.name for p in directory.iterdir() if p.name not in ours)
    if others:
        shown: Sequence[str] = others[:3]
        raise FolderError(
            f"{directory} is not a folder of an experiment, and not empty (it has "
            f"{', '.join(shown)}{', …' if len(others) > 3 else ''}): choose another --out"
        )


def _short(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "…"
