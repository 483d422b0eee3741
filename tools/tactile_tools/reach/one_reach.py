"""One reach in real processes: cupboard with its arm, tactiled, reachd; armd where a robot moves.

`tactile demo` shows one such reach, `tactile arm-scenes` counts many.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from tactile_core.cli import CommandError
from tactile_tools.processes import command, running, socket_at, wait_for

BOARD: Final = "finger"

EMULATED: Final = ("ur", "xarm")
"""Robots that are emulated, and served by armd through their vendor's client."""

ARMS: Final = ("simulated", *EMULATED)

ROBOT_PORTS: Final = {"ur": (29999, 30001, 30002, 30003, 30004), "xarm": (30502, 30003)}
"""TCP ports of the emulated robots; those of ``ur`` are fixed by its protocol."""

FIRST_ADDRESS: Final = 23
"""127.0.0.23 and the addresses after it are hardly ever somebody else's."""

CONFIG: Final = """\
[robot]
address = "{address}"
acceleration = 10.0  # reachd asks for up to 10 m/s² in these scenes; see docs/arm.md
{port}
[tool]
payload = 0.8
position = [0.0, 0.0, 0.1]
pivot = [0.0, 0.03, 0.02]
pivot_rotation = [0.0, -1.5707963, 0.0]

[frame]
origin = [0.4, -0.2, 0.3]
inside = [0.4, -0.5, 0.3]
left = [0.6, -0.2, 0.3]
"""
"""A cupboard that stands to the robot's right, and a finger across its flange."""


@dataclass(frozen=True, slots=True)
class ReachScene:
    """Which cupboard, and which arm reaches into it. ``arm``: one of `ARMS`."""

    arm: str
    scene: str
    scene_seed: int
    seed: int

    @property
    def words(self) -> list[str]:
        """Options that name the scene."""
        return ["--scene", self.scene, "--scene-seed", str(self.scene_seed)]

    @property
    def parameter_set(self) -> str:
        """Parameter set that belongs to the scene."""
        return parameter_set_of(self.scene)


class ReachRig:
    """All processes of one reach but reachd, in ``folder``; a context manager that starts them.

    The folder must be private and its path short, as `tempfile` makes them. `CommandError` where
    the scene does not exist, RuntimeError where a process does not come up.
    """

    def __init__(self, scene: ReachScene, folder: Path) -> None:
        self.scene = scene
        self.folder = folder
        self.board = folder / BOARD
        self.calibration = folder / "finger.cal.toml"
        self.arm, self.skin, self.reach = (
            socket_at(folder, name) for name in ("arm", "tactiled", "reachd")
        )
        words = [command("simdevice"), "cupboard", *scene.words, "--print-goal"]
        self.goal = _ask(words)
        """X,Y of the target in m, as `reachd --target` takes it."""
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> ReachRig:
        """Start them and wait until each is there."""
        try:
            self._start()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End them."""
        self._stack.close()

    def _start(self) -> None:
        scene, seed = self.scene, str(self.scene.seed)
        words = [command("simdevice"), "calibration", "--seed", seed]
        _ask([*words, "--out", str(self.calibration)])
        cupboard = [
            *(command("simdevice"), "cupboard", *scene.words, "--seed", seed),
            *("--pty", str(self.board), "--listen", self.arm, "--connect", self.skin),
        ]
        config = self.folder / "arm.toml"
        if scene.arm in EMULATED:
            address = free_address(scene.arm)
            port = "port = 30502\n" if scene.arm == "xarm" else ""
            config.write_text(CONFIG.format(address=address, port=port), encoding="utf-8")
            cupboard = [
                *(command("simdevice"), scene.arm, "--config", str(config), "--address", address),
                *(*scene.words, "--seed", seed, "--pty", str(self.board)),
                # To reachd itself, which logs the world: peers do not pass messages on.
                *("--world", "world", "--connect", self.arm, "--connect", self.reach),
            ]
        said = self.folder / "cupboard.txt"
        first = self._stack.enter_context(running(cupboard, said))
        wait_for(self.board, first, said)
        if scene.arm in EMULATED:
            served = [command("armd"), "--driver", scene.arm, "--config", str(config)]
            served += ["--listen", self.arm, "--connect", self.skin]
            self._run("armd", served)
        sensing = [
            *(command("tactiled"), "--port", str(self.board), "--name", BOARD),
            *("--calibration", str(self.calibration), "--no-log"),
            *("--listen", self.skin, "--connect", self.arm),
        ]
        self._run("tactiled", sensing)

    def _run(self, name: str, words: list[str]) -> subprocess.Popen[bytes]:
        return self._stack.enter_context(running(words, self.folder / f"{name}.txt"))

    def reachd(
        self, strategy: str, time_limit_s: float, *more: str, said: Path | None = None
    ) -> subprocess.Popen[bytes]:
        """Start reachd on the rig's target; ``more``: further options of it.

        What it prints goes to the file ``said``, or where ours goes.
        """
        with contextlib.ExitStack() as files:
            out = None if said is None else files.enter_context(said.open("wb"))
            return self._reachd(strategy, time_limit_s, more, out)

    def _reachd(
        self, strategy: str, time_limit_s: float, more: Sequence[str], out: BinaryIO | None
    ) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [
                *(command("reachd"), "--strategy", strategy, "--target", self.goal),
                *("--set", self.scene.parameter_set, "--time-limit", f"{time_limit_s:g}"),
                *("--board", BOARD, "--seed", str(self.scene.seed)),
                *("--listen", self.reach, "--connect", self.arm, "--connect", self.skin, *more),
            ],
            # Its arm is its own: another reach on this machine is no reason to refuse this one.
            env=os.environ | {"TACTILE_RUNTIME_DIR": str(self.folder)},
            stdout=out,
            stderr=None if out is None else subprocess.STDOUT,
        )

    def said(self, name: str) -> str:
        """What "cupboard", "armd" or "tactiled" has printed; empty where it does not run."""
        path = self.folder / f"{name}.txt"
        return path.read_text(errors="replace") if path.exists() else ""

    def arm_errors(self) -> list[str]:
        """Lines in which armd said why it stopped the robot."""
        return [line for line in self.said("armd").splitlines() if " ERROR " in line]


def parameter_set_of(scene: str) -> str:
    """Parameter set that belongs to a kind of scene."""
    return "hardware" if scene == "hardware" else "authors_sim"


def free_address(robot: str) -> str:
    """A loopback address at which all ports of an emulated ``robot`` are free now."""
    for number in range(FIRST_ADDRESS, 255):
        address = f"127.0.0.{number}"
        if all(_is_free(address, port) for port in ROBOT_PORTS[robot]):
            return address
    raise RuntimeError(f"no loopback address is free for an emulated {robot}: end some of them")


def _is_free(address: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


def _ask(words: list[str]) -> str:
    """What a command printed; `CommandError` when it refused."""
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode == 2:
        raise CommandError(done.stderr.strip().splitlines()[-1])
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip() or f"{words[0]} ended with {done.returncode}")
    return done.stdout.strip()
