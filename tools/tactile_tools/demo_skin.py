"""``tactile demo-skin``: simulated boards pressed under tactiled, and a picture of it."""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_device.skin.indenter import load_script
from tactile_core.cli import REFUSED, CommandError, require, working
from tactile_core.geometry import finger
from tactile_core.types import monotonic_now
from tactile_tools.demo import demo_files, what_next
from tactile_tools.plot.series import BoardSeries, LogUnreadableError, read_boards
from tactile_tools.processes import busy_text, command, running, socket_at, wait_for

SEED = 1
ROTATE = "90deg/10s"

PRESSES = """\
# What the indenter does to the simulated finger. Times in s, forces in N, lengths in mm.

[[press]]            # a slow, firm press on the left side, with shear toward the tip
array = "left"
u_mm = 8.0
v_mm = 8.0
normal_n = 4.0
shear_n = [-1.5, 0.0]
radius_mm = 8.0
start_s = 6.0
ramp_s = 0.8
hold_s = 2.0

[[press]]            # light, extended contact at the tip, as when an object is pushed along
array = "tip"
u_mm = 6.0
v_mm = 8.0
normal_n = 2.0
shear_n = [0.0, 0.5]
radius_mm = 5.0
start_s = 11.0
ramp_s = 0.5
hold_s = 2.5

[[press]]            # a hard, jamming press on the right side while the tip is still touched
array = "right"
u_mm = 20.0
v_mm = -8.0
normal_n = 9.0
shear_n = [3.0, 0.0]
radius_mm = 9.0
start_s = 13.0
ramp_s = 1.0
hold_s = 3.0
"""


def run(options: argparse.Namespace) -> int:
    """Run the demo. Exit status 0: a log with contacts and a picture were left."""
    require("matplotlib", "scipy", extra="plot")
    options.log, options.png = demo_files("demo-skin", options)
    with tempfile.TemporaryDirectory(prefix="tactile-demo-") as folder:
        try:
            return _run(options, Path(folder))
        except (RuntimeError, LogUnreadableError, OSError) as error:
            busy = busy_text()
            raise CommandError(f"{error}{'; ' if busy else ''}{busy}", REFUSED) from error


def _run(options: argparse.Namespace, folder: Path) -> int:
    press, calibration = folder / "press.toml", folder / "finger.cal.toml"
    press.write_text(PRESSES, encoding="utf-8")
    finger_port, skin_port = folder / "finger", folder / "skin"
    simdevice, tactiled = command("simdevice"), command("tactiled")
    subprocess.run(
        [simdevice, "calibration", "--seed", str(SEED), "--out", str(calibration)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    boards = [simdevice, "boards", "--seed", str(SEED), "--rotate", ROTATE]
    options.log.unlink(missing_ok=True)
    print(
        f"A simulated finger turning {ROTATE} in a 50 µT field while it is pressed, "
        "and a simulated AnySkin board."
    )
    with (
        running([*boards, "--pty", str(finger_port), "--press", str(press)], folder / "a") as first,
        running([*boards, "--pty", str(skin_port), "--kind", "anyskin"], folder / "b") as second,
    ):
        wait_for(finger_port, first, folder / "a")
        power_on = monotonic_now()
        wait_for(skin_port, second, folder / "b")
        done = subprocess.run(
            [
                tactiled,
                *(
                    "--port",
                    str(finger_port),
                    "--name",
                    "finger",
                    "--calibration",
                    str(calibration),
                ),
                *("--port", str(skin_port), "--name", "skin"),
                *("--log", str(options.log), "--duration", str(options.duration)),
                *("--listen", socket_at(folder, "tactiled")),
            ],
            check=False,
        )
    if done.returncode != 0:
        raise RuntimeError(f"tactiled ended with exit code {done.returncode}; see above")
    series = read_boards(options.log)
    board = series["finger"]
    time = np.asarray(board.feature_time)
    applied = _applied(press, time + (board.start_ns - power_on) * 1e-9)
    _summarise(board, applied)
    from tactile_tools.plot.skin import draw

    with working("drawing"):
        draw(board, options.png, applied=(time, applied.sum(axis=1)))
    print(what_next(options.log, options.png))
    return 0


def _applied(press: Path, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normal force truly applied to each array, shape (times, arrays), N.

    ``seconds``: instants after power-on.
    """
    geometry = finger()
    indenter = load_script(press, geometry)
    force = np.zeros((len(seconds), len(geometry.arrays)))
    for row, moment in enumerate(seconds):
        for contact in indenter.contacts(float(moment)):
            away = [
                np.linalg.norm(a.position - contact.position, axis=1).min() for a in geometry.arrays
            ]
            array = int(np.argmin(away))
            nearest = geometry.arrays[array].position - contact.position
            normal = geometry.arrays[array].rotation[np.linalg.norm(nearest, axis=1).argmin()][:, 2]
            force[row, array] -= contact.force @ normal
    return force


def _summarise(board: BoardSeries, applied: NDArray[np.float64]) -> None:
    """Print the felt forces beside the applied ones."""
    felt = board.contact_force()
    plane = np.stack([np.asarray(m.plane).reshape(-1, 3, 3)[..., 0] for m in board.ambient])
    swing = float(np.ptp(plane, axis=0).max())
    print(
        f"\n{len(board.features)} cycles; the ambient field turned by {swing:.0f} µT "
        "and was removed."
    )
    for index, (name, _) in enumerate(board.array_slices()):
        top = int(applied[:, index].argmax())
        idle = felt[applied[:, index] == 0, index]
        print(
            f"  {name:6} pressed with {applied[top, index]:5.2f} N, "
            f"felt {felt[top, index]:5.2f} N; "
            f"{np.sqrt(np.mean(idle**2)):.3f} N rms while untouched"
        )
