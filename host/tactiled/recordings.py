"""Recordings on request: a log beside the daemon's own, started, named and stopped over the bus.

A recording holds everything published for every board of this daemon from its start to its stop;
raw bytes are only in the daemon's own log. It ends at its time limit, and never holds up the
pipeline: files are opened and closed on the caller's thread.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from pathlib import Path
from typing import Any, Literal

import msgspec

from tactile_core.bus.services import ServiceError
from tactile_core.cli import DEFAULT_LOG
from tactile_core.log.recorder import Recorder, RecorderError, RecorderSettings
from tactile_core.types import Instant, WallClock, after, monotonic_now, seconds_between, utc_text
from tactiled.board_session import BoardSession
from tactiled.publisher import MessagePublisher

log = logging.getLogger(__name__)

FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
"""Allowed names of recordings: plain file names, never a path and never hidden."""

LONGEST_S = 86_400.0
"""Longest time limit of one recording."""

USUAL_LIMIT_S = 3600.0
"""Time limit when none is given, so that a forgotten recording does not fill the disk."""

CLOSE_TIMEOUT_S = 20.0
"""Time for a recording to reach the disk when it is stopped on request."""

GEOMETRY_TIMEOUT_S = 5.0
"""Time for the pipeline to describe the boards at the start of a recording."""


class RecordRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``name``: file name without folder; default: the date. ``limit_s``: time limit."""

    action: Literal["start", "stop", "status"] = "status"
    name: str | None = None
    limit_s: float = USUAL_LIMIT_S


class Recordings:
    """One recording at a time for the whole daemon. Thread-safe.

    ``run``: runs a function on the pipeline's thread. ``boards``: returns the boards known now.
    """

    def __init__(
        self,
        publisher: MessagePublisher,
        settings: RecorderSettings,
        destination: Path | None,
        run: Callable[[Callable[[], Any]], Future[Any]],
        boards: Callable[[], list[BoardSession]],
    ) -> None:
        self._publisher = publisher
        # A recording is kept whole: no part is deleted to make room.
        self._settings = msgspec.structs.replace(settings, max_files=None, max_bytes=None)
        self._folder = _folder_of(destination)
        self._run = run
        self._boards = boards
        self._lock = threading.Lock()
        self._recorder: Recorder | None = None
        self._started = monotonic_now()
        self._limit_s = USUAL_LIMIT_S

    def serve(self, request: RecordRequest) -> dict[str, Any]:
        """Answer a request; `ServiceError` names reason and remedy."""
        if request.action == "start":
            return self._start(request)
        if request.action == "stop":
            return self._stop()
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """State of the recording for status and replies."""
        recorder = self._recorder
        if recorder is None:
            return {"recording": False}
        return {"recording": True, "limit_s": self._limit_s} | self._account(recorder)

    def each_second(self, now: Instant) -> None:
        """Stop a recording that has reached its time limit; never waits for the disk."""
        if self._recorder is None or now < after(self._started, self._limit_s):
            return
        recorder = self._detach()
        if recorder is not None:
            log.info("recording %s: stopped after %g s", recorder.stats.path, self._limit_s)
            threading.Thread(
                target=recorder.close, args=(CLOSE_TIMEOUT_S,), name="recording-close", daemon=True
            ).start()

    def close(self) -> bool:
        """End the recording; False when the file could not be finished in time."""
        recorder = self._detach()
        return recorder is None or recorder.close()

    def _start(self, request: RecordRequest) -> dict[str, Any]:
        limit_s = request.limit_s
        if not (math.isfinite(limit_s) and 0 < limit_s <= LONGEST_S):
            raise ServiceError(f"limit_s is {limit_s:g}; allowed: above 0, at most {LONGEST_S:g}")
        path = self._folder / f"{self._name(request.name)}.mcap"
        with self._lock:
            if self._recorder is not None:
                raise ServiceError(
                    f"already recording to {self._recorder.stats.path}: stop that first"
                )
            try:
                recorder = Recorder(path, self._settings, clock=self._publisher.wall)
            except RecorderError as error:
                raise ServiceError(str(error)) from error
            recorder.metadata("recording", {"name": path.stem, "limit_s": f"{limit_s:g}"})
            self._started, self._limit_s = monotonic_now(), limit_s
            self._recorder = self._publisher.recording = recorder
        self._describe_boards()
        return self.summary()

    def _stop(self) -> dict[str, Any]:
        recorder = self._detach()
        if recorder is None:
            raise ServiceError("nothing is being recorded")
        closed = recorder.close(CLOSE_TIMEOUT_S)
        account = self._account(recorder)
        if not closed:
            raise ServiceError(
                f"{account['path']} was not finished in {CLOSE_TIMEOUT_S:g} s; "
                "`tactile log recover` makes it whole"
            )
        return {"recording": False} | account

    def _detach(self) -> Recorder | None:
        with self._lock:
            recorder, self._recorder = self._recorder, None
            self._publisher.recording = None
        return recorder

    def _describe_boards(self) -> None:
        """Write geometry and calibration of every board into the new file."""

        def describe() -> None:
            for board in self._boards():
                board.describe_to(self._recorder)

        try:
            self._run(describe).result(GEOMETRY_TIMEOUT_S)
        except (FutureTimeoutError, ServiceError, ValueError) as error:
            log.warning("recording: the boards could not be described at its start: %s", error)

    def _account(self, recorder: Recorder) -> dict[str, Any]:
        stats = recorder.stats
        # Messages that come after the stop, while the file is closed, are not losses.
        dropped = sum(n for reason, n in stats.dropped.items() if reason != "closed")
        return {
            "path": stats.path,
            "state": stats.state,
            "seconds": round(seconds_between(self._started, monotonic_now()), 3),
            "messages": stats.written + (stats.queued if stats.state == "recording" else 0),
            "bytes": stats.bytes_written,
            "dropped": dropped,
            "error": stats.last_error,
        }

    def _name(self, asked: str | None) -> str:
        if not asked:
            now_ns = WallClock.take().wall_ns(monotonic_now())
            return f"recording_{utc_text(now_ns, '%Y%m%dT%H%M%SZ')}"
        name = asked.removesuffix(".mcap")
        if not FILE_NAME.fullmatch(name):
            raise ServiceError(
                f"{asked[:80]!r} cannot be the name of a recording; allowed: letters, digits, "
                "_, - and ., at most 64, not beginning with . or -"
            )
        return name


def _folder_of(destination: Path | None) -> Path:
    """Folder of the recordings: the same as the daemon's own log."""
    if destination is None:
        return Path(DEFAULT_LOG)
    return destination.parent if destination.suffix == ".mcap" else destination
