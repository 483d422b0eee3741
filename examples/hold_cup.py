"""A gripper that holds a cup by the shear it feels: python hold_cup.py [SECONDS].

The cup is being filled, so it grows heavier. The gripper cannot weigh it, but feels the cup's
weight as shear on the skin, and presses just hard enough for friction to carry it with some
reserve. `GripControl` is the whole control and knows nothing of the simulation: `main` runs it
against a simulated cup that presses on a simulated skin, through tactiled, as a real gripper would.
"""

import contextlib
import os
import pty
import subprocess
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path

import numpy as np

import tactile_reach as tr
from sim_device.board.catalogue import build_skin, factory_calibration, identity
from sim_device.board.firmware import SerialBoard
from sim_device.skin.elastomer import Contact
from tactile_core.calibration import save
from tactile_core.types import monotonic_now

FRICTION = 0.6  # between cup and skin; the control assumes less
G = 9.81


class GripControl:
    """Grip force, N, from felt normal force, shear and the bound of their error.

    ``friction``: coefficient that the control relies on. ``spare``: factor of reserve. ``least``:
    smallest grip, N.
    """

    def __init__(self, friction: float = 0.45, spare: float = 1.3, least: float = 1.0) -> None:
        self.friction, self.spare, self.least = friction, spare, least
        self.grip = least

    def step(self, normal: float, shear: float, bound: float, dt: float) -> float:
        """Grip harder at once if the cup might slip, and softer slowly if it certainly does not.

        Forces in N; ``dt``: time since the last step, s. Returns the new grip force, N.
        """
        wanted = self.spare * (shear + bound) / self.friction
        felt_too_soft = max(0.0, wanted - normal)
        if felt_too_soft > 0.0:
            self.grip += min(8.0 * dt, felt_too_soft)
        else:
            self.grip -= min(0.5 * dt, normal - wanted)
        self.grip = min(max(self.grip, self.least), 15.0)
        return self.grip


class Cup:
    """A cup between two fingers, one of which has the skin; it is filled from 50 to 300 g."""

    def __init__(self, place: np.ndarray, axes: np.ndarray) -> None:
        self.place, self.axes = place, axes
        self.grip = 3.0
        self.taken = False  # set once the fingers may close on it
        self.since: float | None = None
        self.slipped = False
        self.mass = 0.05
        self.held = 0.0

    def contacts(self, seconds: float) -> list[Contact]:
        """Contacts on the skin at ``seconds``: the grip into it, half of the weight along it."""
        if not self.taken:
            return []
        self.since = seconds if self.since is None else self.since
        self.held = seconds - self.since
        self.mass = 0.05 + 0.25 * min(max((self.held - 2.0) / 6.0, 0.0), 1.0)
        weight = self.mass * G / 2
        self.slipped |= weight > FRICTION * self.grip
        force = -self.grip * self.axes[:, 2] - weight * self.axes[:, 1]
        return [Contact(self.place, force, 0.008)]


def serve_board(board: SerialBoard, end: int, stop: threading.Event) -> None:
    """Play the board at the far end of a pseudo-terminal."""
    while not stop.is_set():
        now = monotonic_now()
        with contextlib.suppress(OSError):  # nothing was sent, or nobody is there yet
            board.receive(os.read(end, 4096), now)
        data = board.tick(now)
        with contextlib.suppress(BlockingIOError):  # a full line loses bytes, as a real one does
            os.write(end, data)
        time.sleep(0.004)


def main(seconds: float = 12.0) -> int:
    """Hold the cup for ``seconds``. Returns 0 if it did not slip, 1 if it did."""
    skin = build_skin("finger", 1)
    array = skin.geometry.arrays[0]
    middle = array.taxels // 2 + array.columns // 2
    cup = Cup(array.position[middle - array.columns], array.rotation[middle])
    board = SerialBoard(skin, identity("finger", 1), contacts=cup.contacts)
    end, port = pty.openpty()
    tty.setraw(port)
    os.set_blocking(end, False)
    stop = threading.Event()
    with tempfile.TemporaryDirectory() as name:
        calibration = Path(name) / "finger.cal.toml"
        save(factory_calibration("finger", 1), calibration)
        endpoint = f"unixsock-stream/{name}/tactiled.sock"
        words = ["--port", os.ttyname(port), "--name", "gripper", "--no-log", "--listen", endpoint]
        tactiled = subprocess.Popen(
            [str(Path(sys.executable).with_name("tactiled")), *words, "--calibration", calibration],
            stderr=subprocess.DEVNULL,
        )
        threading.Thread(target=serve_board, args=(board, end, stop), daemon=True).start()
        try:
            with tr.connect(endpoint, find_s=60.0) as bus:
                features = bus.board("gripper").features(timeout_s=30.0)
                control, begin, told = GripControl(), time.monotonic(), 0
                last = begin
                for f in features:
                    now = time.monotonic()
                    # Forces are valid once the untouched skin is tared; only then is the cup taken.
                    cup.taken |= f.valid
                    if not cup.taken and now - begin > 60.0:
                        raise SystemExit("no valid force for a minute: " + "; ".join(f.reasons))
                    if f.valid and f.normal_force > 0.2:
                        bound = min(f.normal_force_bound, 0.3)
                        cup.grip = control.step(f.normal_force, f.shear_force, bound, now - last)
                    last = now
                    if int(cup.held) > told:
                        told = int(cup.held)
                        felt = f"felt {f.normal_force:4.1f} N, shear {f.shear_force:.2f} N"
                        felt = felt if f.valid else "nothing valid felt"
                        print(f"{1e3 * cup.mass:3.0f} g: grip {cup.grip:4.1f} N, {felt}")
                    if cup.held > seconds:
                        break
        finally:
            stop.set()
            tactiled.terminate()
            tactiled.wait()
    print("the cup slipped" if cup.slipped else "the cup was held")
    return int(cup.slipped)


if __name__ == "__main__":
    sys.exit(main(*(float(word) for word in sys.argv[1:2])))
