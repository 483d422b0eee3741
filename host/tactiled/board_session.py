"""One board in service: turns the events of its link into messages, through its pipeline."""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from typing import Any

from tactile_core.bus.topics import AMBIENT, CONTACTS, FEATURES, FIELD, FORCES, GEOMETRY, LOG, Topic
from tactile_core.calibration import BoardCalibration, saves
from tactile_core.calibration.file import SUFFIX
from tactile_core.log.recorder import Recorder
from tactile_core.throttle import Throttle
from tactile_core.types import NS_PER_S, Instant, seconds_between
from tactiled.blocks import Cycle, Features, Reason, SampleBlock
from tactiled.boards.events import (
    Answered,
    BoardLog,
    ClockJudged,
    Event,
    FellSilent,
    Identified,
    Identity,
    Refusal,
    Refused,
    Reported,
    Reset,
    Resumed,
    Sampled,
    Streaming,
)
from tactiled.calibration_store import CalibrationStore, Choice
from tactiled.journal import STATE_PREFIX, describe_state
from tactiled.publisher import MessageMaker, Sink
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings
from tactiled.sensing.reasons import REPLUGGED
from tactiled.sensing.rest import RecordedRest
from tactiled.skin_picture import SkinPicture
from tactiled.watch import ChipWatch, Repeats, Silences

LATENCIES = 512
"""Latencies kept for the percentiles: a second at the fastest rate of the chip (493 Hz)."""

RATE_CYCLES, RATE_OVER = 20, 20
"""The rate is measured over the last `RATE_CYCLES` cycles, but over `RATE_OVER` s at most: a slow
board sends too few in one second."""
STATE_EVERY = 10
"""s between records of a rest field that tracks the drift."""

FIRMWARE_LEVELS = (10, 20, 30, 40)
"""Levels of ``rcl_interfaces/Log``: debug, info, warning, error."""

FIRMWARE_RATE, FIRMWARE_BURST = 10.0, 50
"""Texts of a board's firmware passed on per second, and at once; the bytes of the others are in the
log all the same."""

COMPLAINT_RATE, COMPLAINT_BURST = 0.2, 10
"""Log lines per second, and at once, about messages of one kind that cannot be sent."""

SET_UP_RATE, SET_UP_BURST = 0.5, 10
"""How often per second, and at once, a board may describe itself anew: each time its calibration is
logged."""

TEXT_OLDEST_S, TEXT_AHEAD_S = 3600.0, 1.0
"""s; the stamp of a firmware text that is older, or further in the future, is not believed."""

UNSENT = "unsent_"
"""Prefix of counters of messages that could not be sent; the last part of their key follows."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Latency:
    """Percentiles of the time from received to published, s."""

    p50: float = math.nan
    p99: float = math.nan


class BoardSession:
    """A board in service. Owned by the pipeline's thread; others read its plain attributes."""

    def __init__(
        self, name: str, sink: Sink, store: CalibrationStore, settings: PipelineSettings
    ) -> None:
        self.name = name
        self.node = 0
        """Node of the board on its CAN bus; 0 on a serial line."""
        self.rest_seed: RecordedRest | None = None
        """Rest field to start from, for a recording whose beginning is missing."""
        self.identity: Identity | None = None
        self.choice: Choice | None = None
        self.pipeline: BoardPipeline | None = None
        self.refusal: Refusal | None = None
        self.features: Features | None = None
        self.last: Cycle | None = None
        self.state = "waiting"
        self.rate = 0.0
        self.latency = Latency()
        self.sent = 0
        """Cycles whose forces were published."""
        self.counters: Counter[str] = Counter()
        self.board_status: dict[str, int] = {}
        self.chips: ChipWatch | None = None
        """Which of the board's chips are masked; None before it was identified."""
        self.summary: dict[str, Any] = {}
        """`diagnostics.summary` of the last second; replaced as a whole, for other threads."""
        self._sink = sink
        self._store = store
        self._settings = settings
        self._maker: MessageMaker | None = None
        self._picture: SkinPicture | None = None
        self._warned = ""
        self._state_age = 0  # s since the log was last told of the rest field
        self._latencies: deque[float] = deque(maxlen=LATENCIES)
        self._rate_from: deque[tuple[Instant, int]] = deque([(sink.now(), 0)], RATE_OVER)
        self._repeats = Repeats()
        self._silences = Silences()
        self._unplugged = False
        self._doubt: Reason | None = None
        self._throttles: dict[str, Throttle] = {}
        self._firmware = Throttle(FIRMWARE_RATE, FIRMWARE_BURST)
        self._set_ups = Throttle(SET_UP_RATE, SET_UP_BURST)
        self._answers: dict[int, Future[Event]] = {}
        self._tares: list[Future[dict[str, Any]]] = []

    @property
    def recorder(self) -> Recorder | None:
        """The log that this board's messages go to."""
        return self._sink.recorder

    @property
    def clock_problem(self) -> str:
        """What is wrong with the stamps of this board's messages, or empty; see `WallClock`."""
        return self._sink.wall.problem

    # Who it is

    def admit(self, identity: Identity) -> Refusal | None:
        """Accept a board that a calibration fits (None), or say why not."""
        if identity == self.identity and self.pipeline is not None:
            return None
        # Checked first, because choosing a calibration of 2048 taxels takes a while.
        if not self._set_ups.allow(self._sink.now()):
            return Refusal(
                f"{identity} describes itself anew again and again",
                "power-cycle the board, and look for two boards on one line",
            )
        choice = self._store.choose(identity)
        if isinstance(choice, Refusal):
            return choice
        same = self.choice is not None and self.choice.calibration.hash == choice.calibration.hash
        if not same or self.pipeline is None:
            self._set_up(choice, identity)
        return None

    def recalibrate(self) -> dict[str, Any]:
        """Use the board's calibration file as it is now; ValueError when it does not fit."""
        if self.identity is None:
            raise ValueError("no board has been identified yet")
        choice = self._store.choose(self.identity)
        if isinstance(choice, Refusal):
            raise ValueError(f"{choice.problem}; {choice.remedy}")
        self._set_up(choice, self.identity)
        return self.calibration_summary()

    def calibration_summary(self) -> dict[str, Any]:
        """Which calibration is in use."""
        if self.choice is None:
            return {}
        calibration = self.choice.calibration
        return {
            "serial_number": calibration.serial_number,
            "hash": calibration.hash,
            "nominal": calibration.nominal,
            "file": "" if self.choice.path is None else str(self.choice.path),
        }

    def _set_up(self, choice: Choice, identity: Identity) -> None:
        before = None if self.pipeline is None else self.pipeline.counters
        calibration = choice.calibration
        self.choice, self.identity = choice, identity
        self.pipeline = BoardPipeline(calibration, self._settings)
        if before is not None:
            self.counters.update({k: v for k, v in asdict(before).items() if k not in ("cycles",)})
        if self.rest_seed is not None:
            seed, self.rest_seed = self.rest_seed, None
            try:
                self.pipeline.restore_rest(seed)
            except ValueError as error:
                self._announce(logging.WARNING, f"{error}: tared anew")
        self._maker = MessageMaker(calibration, self._sink.wall)
        self._picture = SkinPicture(calibration.geometry)
        self.chips = ChipWatch(calibration.geometry)
        if self.recorder is not None:
            self._attach_calibration(self.recorder, calibration, identity)
            self._record_state()
        self.send_geometry()

    def describe_to(self, recorder: Recorder | None) -> None:
        """Begin another log of this board: attach its calibration and publish its geometry."""
        if recorder is not None and self.choice is not None and self.identity is not None:
            self._attach_calibration(recorder, self.choice.calibration, self.identity)
        self.send_geometry()

    def _attach_calibration(
        self, recorder: Recorder, calibration: BoardCalibration, identity: Identity
    ) -> None:
        text = saves(calibration).encode()
        recorder.attach(f"{self.name}{SUFFIX}", "application/toml", text)
        summary = {key: str(value) for key, value in self.calibration_summary().items()}
        recorder.metadata(
            f"board:{self.name}",
            {"model": identity.model, "firmware": identity.firmware} | summary,
        )

    def _record_state(self) -> None:
        """Write into every later file of the log what is needed to reprocess it by itself."""
        if self.recorder is not None and self.identity is not None:
            state = None if self.pipeline is None else self.pipeline.rest_to_record()
            table = describe_state(self.node, self.identity, state)
            self.recorder.metadata(f"{STATE_PREFIX}{self.name}", table)
            self._state_age = 0

    def _warn_of_calibration(self) -> None:
        """Warn once about the calibration, and about a board too large to describe whole."""
        choice = self.choice
        if self._maker is not None and not self._maker.whole:
            text = "so many taxels that their geometry goes without the unrolled skin"
            self._announce(logging.WARNING, text, "geometry")
        if choice is not None and choice.warning and choice.warning != self._warned:
            self._warned = choice.warning
            self._announce(logging.WARNING, choice.warning)

    def send_geometry(self) -> None:
        """Publish where the taxels are; does nothing before a board has been identified."""
        if self._maker is not None:
            maker, now_ns = self._maker, self._sink.wall.wall_ns(self._sink.now())
            self._publish(GEOMETRY, lambda: maker.geometry(now_ns), now_ns)

    # What happens

    def handle(self, event: Event) -> None:
        """Act on one event of the board's link."""
        match event:
            case Sampled(block):
                self._on_block(block)
            case Identified(identity, _):
                self.identity, self.refusal, self.state = identity, None, "identified"
                if self.pipeline is not None and self.sent:
                    self.pipeline.reset()  # contacts from before it was away are over
                    if self._unplugged and not identity.serial_number:
                        self.pipeline.forget_rest(REPLUGGED)  # it may be another board
                self._unplugged = False
                version = f", firmware {identity.firmware}" if identity.firmware else ""
                written = f", read as {identity.layout}" if identity.layout else ""
                self._announce(logging.INFO, f"{identity}{version} found{written}", "found")
                self._warn_of_calibration()
            case Streaming(rate):
                self.state = "streaming"
                text = f"streaming at {rate:g} Hz" if rate else "streaming"
                self._announce(logging.INFO, text, "streaming")
            case Refused(refusal):
                self.refusal, self.state = refusal, "refused"
                text = f"refused: {refusal.problem}; {refusal.remedy}"
                self._announce(logging.ERROR, text, "refused")
            case FellSilent(seconds):
                self.state = "silent"
                self.counters["silences"] += 1
                said = self._silences.fell(seconds, self._sink.now())
                if said is not None:
                    self._announce(logging.WARNING, said)
            case Resumed(seconds):
                self.state = "streaming"
                said = self._silences.ended(seconds)
                if said is not None:
                    self._announce(logging.INFO, said)
            case ClockJudged(trouble):
                if trouble:
                    text = (
                        f"clock unusable: {trouble}; features stay invalid until it is right: "
                        "check the tick rate in the board's descriptor, and its oscillator"
                    )
                    self._announce(logging.WARNING, text, "clock")
                else:
                    self._announce(logging.INFO, "the board's clock can be used again", "clock")
            case Reset(reason):
                self.counters["resets"] += 1
                if self.pipeline is not None:
                    self.pipeline.reset()
                self._announce(logging.WARNING, f"the board restarted: {reason}", "restart")
            case BoardLog(level, captured, text):
                self._publish_firmware_text(level, captured, text)
            case Reported(status):
                self.board_status = {
                    "overruns": status.overruns,
                    "rx_errors": status.rx_errors,
                    "chip_errors": status.chip_errors,
                    "uptime_s": status.uptime_ms // 1000,
                }
            case Answered(request, _):
                waiting = self._answers.pop(request, None)
                if waiting is not None:
                    waiting.set_result(event)
            case _:
                raise TypeError(f"no board's event: {event!r}")

    def port_lost(self, reason: str) -> None:
        """The board's port is gone."""
        self.state = "unplugged"
        self._unplugged = True
        self._silences.gone()
        self._announce(logging.WARNING, f"{reason}; waiting for it to come back", "lost")

    def await_answer(self, request: int) -> Future[Event]:
        """Return a future for the board's answer to a request, given by its number."""
        future: Future[Event] = Future()
        self._answers[request] = future
        return future

    def tare(self, force: bool = False) -> Future[dict[str, Any]]:
        """Begin a tare; the future holds its report when it ends.

        ``force``: take the present reading as the rest field even where it looks loaded.
        ValueError when the board is not streaming.
        """
        if self.pipeline is None:
            raise ValueError("no board has been identified yet")
        if self.state != "streaming":
            raise ValueError(f"the board is {self.state}: there are no samples to tare on")
        self.pipeline.tare(force)
        future: Future[dict[str, Any]] = Future()
        self._tares.append(future)
        return future

    def abandon_requests(self, error: Exception) -> None:
        """Fail every request under way."""
        waiting: list[Future[Any]] = [*self._answers.values(), *self._tares]
        for future in waiting:
            if not future.done():
                future.set_exception(error)
        self._answers.clear()
        self._tares.clear()

    def flush(self) -> None:
        """Publish the cycle under way, even if incomplete."""
        if self.pipeline is not None:
            for cycle in self.pipeline.flush():
                self._send(cycle)

    def each_second(self, now: Instant) -> None:
        """Work out rate and latency; report repeated messages and masked chips."""
        self._measure_rate(now)
        for level, text in self._repeats.due(now):
            self._announce(level, text)
        said = self._silences.due(now)
        if said is not None:
            self._announce(logging.WARNING, said)
        if self.chips is not None:
            for level, text in self.chips.each_second(now):
                self._announce(level, text)
        self._report_floods(now)
        if self._latencies:
            ordered = sorted(self._latencies)
            last = len(ordered) - 1
            self.latency = Latency(ordered[last // 2], ordered[math.ceil(last * 0.99)])
            self._latencies.clear()
        else:
            self.latency = Latency()
        self._state_age += 1
        if self._settings.rest_tracking_s is not None and self._state_age >= STATE_EVERY:
            self._record_state()  # a tracked rest field moves all the time

    def _measure_rate(self, now: Instant) -> None:
        """Cycles per second over the shortest span that holds enough of them."""
        marks = self._rate_from
        if self.state != "streaming":
            marks.clear()
            self.rate = 0.0
        for since, count in reversed(marks):
            elapsed = seconds_between(since, now)
            if elapsed > 0:
                self.rate = (self.sent - count) / elapsed
            if self.sent - count >= RATE_CYCLES:
                break
        marks.append((now, self.sent))

    def drops(self) -> dict[str, int]:
        """Count by reason of the cycles, blocks and messages that were lost."""
        counts = Counter(self.counters)
        if self.pipeline is not None:
            counts.update(asdict(self.pipeline.counters))
        if self._maker is not None:
            counts["patches_cut"] = self._maker.patches_cut
        return {reason: n for reason, n in counts.items() if reason.startswith(UNSENT)} | {
            reason: counts[reason]
            for reason in (
                "lost_cycles",
                "incomplete_cycles",
                "late_blocks",
                "duplicate_blocks",
                "unknown_array",
                "wrong_shape",
                "spoilt_events",
                "patches_cut",
                "texts_held_back",
                "texts_without_time",
            )
        }

    def _on_block(self, block: SampleBlock) -> None:
        pipeline = self.pipeline
        if pipeline is None:
            return
        before = pipeline.tare_report
        for cycle in pipeline.feed(block):
            self._send(cycle)
        doubt = pipeline.rest_reason
        if doubt is not self._doubt:
            if doubt is not None and (self._doubt is None or self._doubt.code != doubt.code):
                self._announce(logging.WARNING, doubt.text, "rest field in doubt")
            self._doubt = doubt
        report = pipeline.tare_report
        if report is not None and report is not before:
            level = logging.INFO if report.accepted else logging.WARNING
            self._announce(level, report.message, "" if report.accepted else "tare refused")
            result = {
                "accepted": report.accepted,
                "message": report.message,
                "cycles": report.cycles,
                "shift_ut": report.shift_ut,
                "noise_ut": report.noise_ut.tolist(),
            }
            for future in self._tares:
                future.set_result(result)
            self._tares.clear()
            if report.accepted:
                self._record_state()

    def _send(self, cycle: Cycle) -> None:
        maker, sink = self._maker, self._sink
        if maker is None:
            return
        stamp_ns = sink.wall.wall_ns(cycle.captured)
        if self.chips is not None:
            self.chips.observe(cycle.fault, cycle.captured)
        if cycle.features_due:
            self._publish(FEATURES, lambda: maker.features(cycle), stamp_ns)
        self._latencies.append((sink.now() - cycle.received) / NS_PER_S)
        self._publish(FORCES, lambda: maker.forces(cycle), stamp_ns)
        self._publish(FIELD, lambda: maker.field(cycle), stamp_ns)
        if cycle.ambient.method != "off":
            self._publish(AMBIENT, lambda: maker.ambient(cycle), stamp_ns)
        self.features, self.last = cycle.features, cycle
        self.sent += 1
        if self._picture is not None:
            self._publish_picture(self._picture, cycle, stamp_ns)

    def _publish_picture(self, picture: SkinPicture, cycle: Cycle, stamp_ns: int) -> None:
        """Send a picture when one is due; it is for viewers only, so a failure is just counted."""
        try:
            parts = picture.draw(cycle, stamp_ns) if picture.due(cycle.captured) else []
            for part in parts:
                self._sink.send(CONTACTS, self.name, part, stamp_ns)
        except Exception as error:  # noqa: BLE001 - features go on without it
            self._note_unsent(CONTACTS, error)

    def _publish(self, topic: Topic, make: Callable[[], Any], stamp_ns: int) -> None:
        """Make a message and send it; count it when that fails."""
        try:
            self._sink.send(topic, self.name, make(), stamp_ns)
        except Exception as error:  # noqa: BLE001 - one message must not end the others
            self._note_unsent(topic, error)

    def _note_unsent(self, topic: Topic, error: Exception) -> None:
        kind = topic.template.rpartition("/")[2]
        self.counters[UNSENT + kind] += 1
        if self._throttle(UNSENT + kind).allow(self._sink.now()):
            log.error("%s: a message of %s cannot be sent: %s", self.name, kind, error)

    def event_failed(self, error: Exception) -> None:
        """Count an event lost to an error; reset the pipeline, whose state may be inconsistent."""
        self.counters["spoilt_events"] += 1
        if self._throttle("spoilt").allow(self._sink.now()):
            log.error("%s: an event could not be processed", self.name, exc_info=error)
        if self.pipeline is not None:
            self.pipeline.reset()

    def announce_log_state(self, level: int, text: str) -> None:
        """Announce a change of the log that this board's messages go to."""
        self._announce(level, text)

    def _publish_firmware_text(self, level: int, captured: Instant, text: str) -> None:
        """Publish and log a text of the firmware, unless there have been too many."""
        now = self._sink.now()
        if not self._firmware.allow(now):
            self.counters["texts_held_back"] += 1
            return
        age = seconds_between(captured, now)
        if not -TEXT_AHEAD_S <= age <= TEXT_OLDEST_S:
            self.counters["texts_without_time"] += 1
            captured, text = now, f"{text} (when is not known: its clock says {age:.0f} s ago)"
        known = max((n for n in FIRMWARE_LEVELS if n <= level), default=10)
        self._publish_text(known, text, f"{self.name} firmware", captured)

    def _announce(self, level: int, text: str, kind: str = "") -> None:
        """Announce ``text``; one with a ``kind`` only when the last of that kind is a while ago."""
        if not kind or self._repeats.should_report(kind, text, level, self._sink.now()):
            self._publish_text(level, text)
        else:
            self.counters["texts_held_back"] += 1

    def _report_floods(self, now: Instant) -> None:
        """Say how many texts of the firmware were held back, once the limit allows it."""
        firmware = self._firmware
        if firmware.held and firmware.ready(now):
            held = firmware.take_held()
            firmware.allow(now)
            self._publish_text(logging.WARNING, f"{held} texts held back, too many: firmware")

    def _publish_text(
        self, level: int, text: str, firmware: str = "", captured: Instant | None = None
    ) -> None:
        try:
            if firmware:
                self._sink.firmware_text(self.name, level, firmware, text, captured)
            else:
                self._sink.announce(self.name, level, text)
        except Exception as error:  # noqa: BLE001 - one text must not end the features
            self._note_unsent(LOG, error)

    def _throttle(self, kind: str) -> Throttle:
        return self._throttles.setdefault(kind, Throttle(COMPLAINT_RATE, COMPLAINT_BURST))
