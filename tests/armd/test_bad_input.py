"""What is wrong is said in one sentence with its remedy, and nothing moves."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from armd.cli import main
from armd.config import load_config

pytestmark = pytest.mark.skipif(
    "ARMS_RUNS" not in os.environ, reason="drives emulated robots in real time: `make arms`"
)

Run = Callable[..., subprocess.CompletedProcess[str]]

GOOD = """\
[robot]
address = "127.0.0.1"
[tool]
payload = 0.8
position = [0.0, 0.0, 0.1]
pivot = [0.0, 0.03, 0.02]
pivot_rotation = [0.0, -1.5707963, 0.0]
"""
FRAME = """
[frame]
origin = [0.4, -0.2, 0.3]
inside = [0.4, -0.5, 0.3]
left = [0.6, -0.2, 0.3]
"""


def refused(done: subprocess.CompletedProcess[str], code: int, says: str) -> None:
    assert done.returncode == code, done.stderr
    line = next(
        text for text in done.stderr.splitlines() if text.startswith(("armd: ", "armd teach: "))
    )
    assert re.search(says, line), line
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("driver", "text", "code", "says"),
    [
        ("mock", GOOD, 2, r"frame\] is missing.*armd teach"),
        ("mock", GOOD + FRAME.replace("0.6, -0.2", "0.2, -0.2"), 2, "mirrored"),
        ("mock", GOOD.replace("payload = 0.8", "") + FRAME, 2, "payload is missing"),
        ("mock", GOOD.replace("address", "adress") + FRAME, 2, "did you mean address"),
        ("mock", GOOD.replace("[tool]", "watchdog = 10.0\n[tool]") + FRAME, 2, "from 20"),
    ],
)
def test_configurations(
    capsys: pytest.CaptureFixture[str], tmp_path: Path,
    driver: str, text: str, code: int, says: str,
) -> None:  # fmt: skip
    path = tmp_path / "arm.toml"
    path.write_text(text)
    assert main(["--driver", driver, "--config", str(path)]) == code
    assert re.search(says, capsys.readouterr().err)


@pytest.mark.parametrize("driver", ["ur", "xarm"])
def test_a_robot_that_is_not_there(
    armd_command: Run, skip: Callable[[str], None], tmp_path: Path, driver: str
) -> None:
    skip(driver)
    path = tmp_path / "arm.toml"
    path.write_text(GOOD.replace("127.0.0.1", "127.0.9.9") + FRAME)
    where = f"unixsock-stream/{tmp_path / 'a.sock'}"
    done = armd_command(
        "--driver", driver, "--config", path, "--listen", where, "--connect", where + ".none"
    )
    refused(done, 3, "no robot at 127.0.9.9")


def test_a_robot_that_is_set_up_otherwise(
    armd_command: Run, robot: Callable[[str], Any], tmp_path: Path
) -> None:
    made = robot("ur")
    where = f"unixsock-stream/{tmp_path / 'a.sock'}"
    bus = ("--listen", where, "--connect", where + ".none")
    good = made.config.read_text()
    for fault, change, code, says in (
        ("local", ("", ""), 3, "local mode"),
        ("payload 1.4", ("", ""), 2, "payload of 1.40 kg"),
        ("payload 0.8", ("0.0, 0.0, 0.1]", "0.0, 0.0, 0.15]"), 2, "50.0 mm from"),
        ("payload 0.8", ("left = [0.6, -0.2, 0.3]", "left = [0.6, -0.2, 0.37]"), 2, "leans"),
        ("protective_stop", ("", ""), 3, "protective stop"),
    ):
        made.fault("remote")
        made.fault("release")
        at = made.fault(fault)
        made.config.write_text(good.replace(*change) if change[0] else good)
        refused(armd_command("--driver", "ur", "--config", made.config, *bus), code, says)
        assert all(row[3] == 0.0 for row in made.truth() if row[0] > at)


def test_teaching_three_points(
    armd_command: Run, robot: Callable[[str], Any], tmp_path: Path
) -> None:
    made = robot("ur")
    path = tmp_path / "new.toml"
    text, _, _ = made.config.read_text().partition("[frame]")
    path.write_text(text)
    done = armd_command("teach", "--driver", "ur", "--config", path, lines="\n")
    refused(done, 2, "ended before the point inside")
    done = armd_command("teach", "--driver", "ur", "--config", path, lines="\n\n\n")
    refused(done, 2, "mm apart")
    assert "[frame]" not in path.read_text()


def test_taught_points_are_where_the_tip_was(robot: Callable[[str], Any], tmp_path: Path) -> None:
    made = robot("ur")
    path = tmp_path / "new.toml"
    text, _, _ = made.config.read_text().partition("[frame]")
    path.write_text(text)
    command = Path(sys.executable).with_name("armd")
    taught = subprocess.Popen(
        [command, "teach", "--driver", "ur", "--config", path],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert taught.stdin is not None
    assert taught.stdout is not None
    said = ""
    for place in ("-0.158 0 0", "0.042 0 0", "-0.158 0.2 0"):
        while not said.endswith("press Enter. "):
            said += taught.stdout.read(1)
        made.fault(f"place {place}")
        taught.stdin.write("\n")
        taught.stdin.flush()
        said = ""
    out, _ = taught.communicate(timeout=120)
    assert taught.returncode == 0, out
    frame = load_config(path).frame
    assert frame is not None
    assert frame.origin == pytest.approx((0.4, -0.2, 0.3), abs=2e-4)
    assert frame.inside == pytest.approx((0.4, -0.4, 0.3), abs=2e-4)
    assert frame.left == pytest.approx((0.6, -0.2, 0.3), abs=2e-4)
