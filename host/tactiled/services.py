"""Services of a running board: status, tare, set_rate, recalibrate, geometry, record.

Requests arrive on zenoh's threads and are carried out by the pipeline's thread. Every failure is
answered with an error reply.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any, TypeVar

import msgspec
import zenoh

from sensor_proto.packets import AckResult, SetRate
from tactile_core.bus.services import Service, ServiceError, declare_service
from tactile_core.bus.topics import service_key
from tactile_core.calibration import CalibrationError
from tactile_core.types import monotonic_now
from tactiled import journal
from tactiled.board_session import BoardSession
from tactiled.boards.board import BoardLink
from tactiled.boards.events import Answered, Event
from tactiled.calibration_store import CalibrationStore
from tactiled.diagnostics import log_summary, summary
from tactiled.port import Port
from tactiled.recordings import Recordings, RecordRequest

PIPELINE_TIMEOUT = 5.0
"""s for the pipeline's thread to take up a request; it looks for one every 10 ms."""

TARE_TIMEOUT = 15.0
"""s for a tare: ten times its usual half second, and the retries of a first one."""

TARE_CYCLES = 40
"""Further cycles that a tare may take; on a slow board they last longer."""

SLOWEST_HZ = 0.5
"""Lowest rate that timeouts allow for."""

COMMAND_TIMEOUT = 3.0
"""s for a board's answer: five tries of 0.2 s, and time for the commands queued before it."""

T = TypeVar("T")

Run = Callable[[Callable[[], T]], "Future[T]"]
"""Runs a function on the pipeline's thread."""


class Nothing(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A request without parameters."""


class TareRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``force``: take the present reading as the rest field even where it looks loaded."""

    force: bool = False


class RateRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``rate_hz``: samples per second, above 0."""

    rate_hz: float


class BoardServices:
    """The services of one board."""

    def __init__(
        self,
        session: zenoh.Session,
        run: Callable[[Callable[[], Any]], Future[Any]],
        store: CalibrationStore,
        port: Port,
        node: int,
        board: BoardSession,
        recordings: Recordings,
        prefix: str = "",
    ) -> None:
        self._run = run
        self._recordings = recordings
        self._store = store
        self._port = port
        self._node = node
        self._board = board
        handlers: dict[str, tuple[Callable[[Any], object], type]] = {
            "status": (self._status, Nothing),
            "tare": (self._tare, TareRequest),
            "set_rate": (self._set_rate, RateRequest),
            "recalibrate": (self._recalibrate, Nothing),
            "geometry": (self._geometry, Nothing),
            "record": (recordings.serve, RecordRequest),
        }
        lead = f"{prefix}/" if prefix else ""
        self._services: list[Service] = [
            declare_service(session, lead + service_key(board.name, name), handler, request)
            for name, (handler, request) in handlers.items()
        ]

    def close(self) -> None:
        """Undeclare the services."""
        for service in self._services:
            service.close()

    def _status(self, _: Nothing) -> dict[str, Any]:
        def sum_up() -> dict[str, Any]:
            values = summary(self._port, self._node, self._board, monotonic_now())
            recorder = self._board.recorder
            values["alarms"] = self._board.summary.get("alarms", [])
            values["recording"] = self._recordings.summary()
            return values | {"log": None if recorder is None else log_summary(recorder)}

        result: dict[str, Any] = self._do(sum_up)
        return result

    def _tare(self, request: TareRequest) -> dict[str, Any]:
        def begin() -> Future[dict[str, Any]]:
            ending = self._board.tare(request.force)
            value = float(request.force)
            self._port.note(journal.TARE, monotonic_now(), node=self._node, value=value)
            return ending

        future: Future[dict[str, Any]] = self._do(begin)
        stuck = "the tare did not end: no samples are coming"
        timeout = TARE_TIMEOUT + TARE_CYCLES / max(self._board.rate, SLOWEST_HZ)
        report: dict[str, Any] = self._await(future, timeout, stuck)
        if not report["accepted"]:
            raise ServiceError(report["message"])
        return report

    def _set_rate(self, request: RateRequest) -> dict[str, float]:
        rate = request.rate_hz
        if not (math.isfinite(rate) and rate > 0):
            raise ServiceError(f"rate_hz is {rate:g}; allowed: a finite number above 0")
        future: Future[Event] = self._do(lambda: self._ask_rate(rate))
        answer = self._await(future, COMMAND_TIMEOUT, "the board did not answer")
        if not isinstance(answer, Answered) or answer.ack is None:
            raise ServiceError("the board did not answer")
        if answer.ack.result is not AckResult.OK:
            raise ServiceError(f"the board refuses {rate:g} Hz: {answer.ack.result.name}")
        return {"rate_hz": rate}

    def _ask_rate(self, rate: float) -> Future[Event]:
        link = self._port.line.links.get(self._node)
        if not isinstance(link, BoardLink):
            what = "the board" if link is None else f"the {self._board.identity}"
            raise ServiceError(f"{what} takes no commands: its rate cannot be set")
        identity = self._board.identity
        if identity is not None and identity.max_rate is not None and rate > identity.max_rate:
            raise ServiceError(
                f"rate_hz is {rate:g}; the board takes {identity.max_rate:g} at most"
            )
        mhz = round(rate * 1000)
        if mhz < 1:
            raise ServiceError(f"rate_hz is {rate:g}; the finest step is 0.001")
        now = monotonic_now()
        request = link.request(lambda n: SetRate(n, mhz), now)
        self._port.note(journal.SET_RATE, now, node=self._node, value=rate)
        return self._board.await_answer(request)

    def _recalibrate(self, _: Nothing) -> dict[str, Any]:
        def reload() -> dict[str, Any]:
            self._store.reload()
            now = monotonic_now()
            self._port.retry(self._node, now)
            told = self._board.recalibrate()
            self._port.note(journal.RECALIBRATE, now, node=self._node, text=told["hash"])
            return told

        result: dict[str, Any] = self._do(reload)
        return result

    def _geometry(self, _: Nothing) -> dict[str, Any]:
        def publish() -> dict[str, Any]:
            choice = self._board.choice
            if choice is None:
                raise ServiceError("no board has been identified yet")
            self._board.send_geometry()
            geometry = choice.calibration.geometry
            return {
                "model": geometry.model,
                "frame": geometry.frame,
                "arrays": [
                    {
                        "name": a.name,
                        "side": a.side.name.lower(),
                        "rows": a.rows,
                        "columns": a.columns,
                        "position_m": a.position.round(6).tolist(),
                        "normal": a.rotation[:, :, 2].round(6).tolist(),
                    }
                    for a in geometry.arrays
                ],
            }

        result: dict[str, Any] = self._do(publish)
        return result

    def _do(self, work: Callable[[], Any]) -> Any:
        busy = f"tactiled is busy and did not answer within {PIPELINE_TIMEOUT:g} s"
        return self._await(self._run(work), PIPELINE_TIMEOUT, f"{busy}; it may still do it")

    def _await(self, future: Future[Any], timeout: float, otherwise: str) -> Any:
        try:
            return future.result(timeout)
        except FutureTimeoutError:
            raise ServiceError(otherwise) from None
        except (CalibrationError, ValueError) as error:
            raise ServiceError(str(error)) from error
