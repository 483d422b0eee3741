"""Log of a trial in lockstep: the same topics and messages as the daemons write."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from reachd.interfaces import Touch, Twist
from sim_device.board.catalogue import factory_calibration
from sim_device.world.base import FingerContact
from sim_device.world.scene_markers import scene_markers
from sim_device.world.scenes import Scene
from tactile_core.bus.commanding import command_message
from tactile_core.bus.markers import frame_transform, wipe
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.topics import (
    AMBIENT,
    ARM_STATE,
    COMMAND,
    CONTACTS,
    FEATURES,
    FORCES,
    GEOMETRY,
    REACH_EVENT,
    REACH_STATE,
    TF,
    WORLD,
    Topic,
)
from tactile_core.geometry import Side
from tactile_core.log.recorder import Recorder
from tactile_core.types import Instant, WallClock
from tactile_tools.reach.lockstep import Result, Step
from tactiled.blocks import Cycle
from tactiled.publisher import MessageMaker
from tactiled.skin_picture import SkinPicture, patch_markers

EPOCH_NS = 1_700_000_000_000_000_000
"""Wall-clock time at which every trial begins: a log depends on the trial alone."""

WORLD_PERIOD_NS = 100_000_000
"""Time between two messages of the world's markers: 10 Hz, as on the bus."""

FRAME_PERIOD_NS = 40_000_000
"""Time between two transforms of the frame ``ee``: 25 Hz."""

MAX_QUEUED = 8192  # half of the recorder's queue: virtual time outruns a disk, nothing may be lost
BOARD, ARM, REACH = "finger", "arm", "reach"


class TrialLog:
    """Writes each `Step` it is called with. A context manager; closes the file at the end."""

    def __init__(self, path: Path, scene: Scene, strategy: str, seed: int) -> None:
        self._wall = WallClock(EPOCH_NS)
        self._recorder = Recorder(path, clock=self._wall)
        self._recorder.attach("scene.json", "application/json", scene.to_json().encode())
        self._recorder.metadata(
            "trial", {"strategy": strategy, "seed": str(seed), "scene_seed": str(scene.seed)}
        )
        calibration = factory_calibration("finger", seed)
        self._maker = MessageMaker(calibration, self._wall)
        self._picture = SkinPicture(calibration.geometry)
        self._described = False
        self._strategy = strategy
        self._sequence = 0
        self._next_world = self._next_frame = 0
        self._felt = -1
        self._last = Instant(0)
        self._state = ""

    def __enter__(self) -> TrialLog:
        """Return itself, ready to be called."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file; RuntimeError if something could not be written."""
        whole = self._recorder.close(30.0)
        if error is None and (not whole or self._recorder.stats.dropped):
            raise RuntimeError(f"the log is not whole: {self._recorder.stats}")

    def __call__(self, step: Step) -> None:
        """Write one control cycle."""
        now, arm, touch = step.now, step.arm, step.touch
        if now >= self._next_world:
            self._next_world = now + WORLD_PERIOD_NS
            self._write(WORLD, "world", scene_markers(step.world, self._wall.wall_ns(now)), now)
        stamp = header(self._wall.wall_ns(arm.captured), "cupboard")
        moment = MSG.Vector3(0.0, 0.0, arm.mz)
        state = MSG.ArmState(
            stamp, arm.captured, self._sequence, arm.x, arm.y, arm.heading, _twist(arm.twist),
            MSG.Wrench(MSG.Vector3(arm.fx, arm.fy, 0.0), moment), arm.mode,
            arm.v_max, arm.omega_max, arm.f_max, arm.m_max, "", 0, 0,
        )  # fmt: skip
        self._write(ARM_STATE, ARM, state, now)
        if now >= self._next_frame:
            self._next_frame = now + FRAME_PERIOD_NS
            pose = (arm.x, arm.y, 0.0, arm.heading)
            frame = frame_transform(self._wall.wall_ns(arm.captured), "cupboard", "ee", pose)
            self._write(TF, "tf", frame, now)
        if touch is not None and touch.captured != self._felt:
            self._felt = touch.captured
            if step.cycle is not None:
                self._skin(step.cycle)
            else:
                self._contacts(touch, step.world.contacts())
        stamp = header(self._wall.wall_ns(now), "cupboard")
        sent, expiry = step.control.decision.twist, step.control.decision.expiry
        wall_ns = self._wall.wall_ns(now)
        command = command_message(sent, now, expiry, wall_ns, sequence=self._sequence + 1)
        self._write(COMMAND, ARM, command, now)
        self._write(REACH_STATE, REACH, self._reach_state(step, stamp), now)
        for event in step.control.events:
            self._event(now, event.family, event.kind, f"{event.direction} {event.trigger}")
        for intervention in step.control.onsets:
            text = f"{intervention.effect}: {intervention.text}"
            self._event(now, "intervention", intervention.code, text)
        if step.control.status.state != self._state:
            self._state = step.control.status.state
            self._event(now, "state", self._state, step.control.status.text)
        self._sequence += 1
        self._last = now
        while self._recorder.stats.queued > MAX_QUEUED:
            time.sleep(0.002)

    def _skin(self, cycle: Cycle) -> None:
        """Write what a board felt, as tactiled does."""
        maker, captured = self._maker, cycle.captured
        if not self._described:
            self._described = True
            geometry = maker.geometry(self._wall.wall_ns(captured))
            self._write(GEOMETRY, BOARD, geometry, captured)
        self._write(FEATURES, BOARD, maker.features(cycle), captured)
        self._write(FORCES, BOARD, maker.forces(cycle), captured)
        if cycle.ambient.method != "off":
            self._write(AMBIENT, BOARD, maker.ambient(cycle), captured)
        if self._picture.due(captured):
            for picture in self._picture.draw(cycle, self._wall.wall_ns(captured)):
                self._write(CONTACTS, BOARD, picture, captured)

    def _contacts(self, touch: Touch, contacts: tuple[FingerContact, ...]) -> None:
        """Write what was felt without taxels: the engine's own contacts."""
        self._write(FEATURES, BOARD, self._features(touch, contacts), touch.captured)
        if self._picture.due(touch.captured):
            wall_ns = self._wall.wall_ns(touch.captured)
            felt = [
                ((c.x, c.y, 0.0), (c.force_x, c.force_y, 0.0), c.normal_force) for c in contacts
            ]
            made = [wipe(wall_ns, "ee"), *patch_markers(wall_ns, "ee", felt)]
            self._write(CONTACTS, BOARD, MSG.MarkerArray(made), touch.captured)

    def outcome(self, result: Result) -> None:
        """Write how it ended, at the last cycle's time."""
        self._event(self._last, "outcome", result.outcome.reason, result.outcome.text)
        self._recorder.metadata("outcome", {"json": json.dumps(asdict(result), default=str)})

    def _reach_state(self, step: Step, stamp: Any) -> Any:
        status, decision = step.control.status, step.control.decision
        goal = status.goal
        return MSG.ReachState(
            header=stamp,
            stamped_ns=step.now,
            sequence=self._sequence,
            state=str(status.state),
            activity=status.activity,
            strategy=self._strategy,
            goal=MSG.Point(*((goal.x, goal.y) if goal else (0.0, 0.0)), 0.0),
            goal_radius=goal.radius if goal else 0.0,
            distance=status.distance,
            elapsed=status.elapsed,
            wanted=_twist(step.control.wanted or Twist(0.0, 0.0, 0.0)),
            commanded=_twist(decision.twist),
            armed=decision.held is None,
            held=decision.held or "",
            interventions=[str(i.code) for i in decision.interventions],
            features_age=_age(step.touch, step.now),
            arm_age=(step.now - step.arm.captured) * 1e-9,
            lateness=0.0,
        )

    def _features(self, touch: Touch, contacts: tuple[FingerContact, ...]) -> Any:
        """Features message; its patches are the engine's contacts, for the picture."""
        patches = [
            MSG.ContactPatch(
                array=0,
                side=int(Side.NONE),
                taxels=0,
                normal_force=c.normal_force,
                peak_force=c.normal_force,
                force=MSG.Vector3(c.force_x, c.force_y, 0.0),
                centroid=MSG.Point(c.x, c.y, 0.0),
                normal=MSG.Vector3(c.normal_x, c.normal_y, 0.0),
                normal_force_bound=0.0,
            )
            for c in contacts
        ]
        return MSG.ContactFeatures(
            header=header(self._wall.wall_ns(touch.captured), "ee"),
            captured_ns=touch.captured,
            received_ns=touch.received,
            uncertainty=0.0,
            sequence=self._sequence,
            valid=touch.valid,
            reasons=[],
            calibrated=True,
            peak_force=touch.peak_force,
            peak_side=int(touch.peak_side),
            peak_position=MSG.Point(touch.peak_x, touch.peak_y, 0.0),
            normal_force=touch.total_force,
            wrench=MSG.Wrench(
                MSG.Vector3(touch.wrench.fx, touch.wrench.fy, 0.0),
                MSG.Vector3(0.0, 0.0, touch.wrench.mz),
            ),
            tip_force=touch.tip_force,
            tip_contact_time=touch.tip_contact_time,
            taxels_in_contact=0,
            taxels_masked=0,
            patches=patches,
            reason_codes=[],
            peak_force_bound=0.0,  # the engine's own contacts
            normal_force_bound=0.0,
            tip_force_bound=0.0,
        )

    def _event(self, now: Instant, kind: str, code: str, text: str) -> None:
        stamp = header(self._wall.wall_ns(now), "cupboard")
        self._write(REACH_EVENT, REACH, MSG.ReachEvent(stamp, now, kind, str(code), text), now)

    def _write(self, topic: Topic, name: str, message: Any, now: int) -> None:
        wall_ns = now + EPOCH_NS
        self._recorder.write(topic, name, codec().encode(topic, message), wall_ns, wall_ns)


def _twist(twist: Twist) -> Any:
    return MSG.Twist(
        MSG.Vector3(twist.vx, twist.vy, 0.0), MSG.Vector3(0.0, 0.0, float(twist.omega))
    )


def _age(touch: Touch | None, now: int) -> float:
    return float(np.nan) if touch is None else (now - touch.captured) * 1e-9
