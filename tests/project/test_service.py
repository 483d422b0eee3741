"""`tactile service`: installs and removes files that systemd and udev accept."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from reachd.settings import ConfigFile as ReachConfig
from tactile_core.config import load_toml
from tactile_tools.cli import main
from tactile_tools.operate.service import UNITS
from tactiled.settings import ConfigFile as SkinConfig

ALLOWED_EXPOSURE = 4.0
RULE = re.compile(r'[A-Z_]+(?:\{\w+\})?(==|!=|\+=|=)"[^"]*"$')


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A system with everything installed."""
    assert main(["service", "install", "--root", str(tmp_path)]) == 0
    return tmp_path


def files(root: Path) -> set[str]:
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}


ALL = {
    "etc/systemd/system/tactiled.service",
    "etc/systemd/system/reachd.service",
    "etc/sysusers.d/tactile.conf",
    "etc/udev/rules.d/70-tactile.rules",
    "etc/tactile/tactiled.toml",
    "etc/tactile/reachd.toml",
}


def test_service_installs_and_uninstalls_the_listed_files(root: Path) -> None:
    assert files(root) == ALL
    assert main(["service", "uninstall", "--root", str(root)]) == 0
    assert files(root) == {"etc/tactile/tactiled.toml", "etc/tactile/reachd.toml"}
    assert main(["service", "uninstall", "--root", str(root), "--purge"]) == 0
    assert files(root) == set()
    assert main(["service", "uninstall", "--root", str(root), "--purge"]) == 0


def test_user_configuration_is_kept(root: Path) -> None:
    mine = root / "etc/tactile/tactiled.toml"
    mine.write_text("rate = 50\n", encoding="utf-8")
    (root / "etc/systemd/system/tactiled.service").write_text("old", encoding="utf-8")
    assert main(["service", "install", "--root", str(root)]) == 0
    assert mine.read_text(encoding="utf-8") == "rate = 50\n"
    unit = (root / "etc/systemd/system/tactiled.service").read_text(encoding="utf-8")
    assert unit.startswith("# Made by")


def test_dry_run_writes_and_deletes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["service", "install", "--root", str(tmp_path), "--dry-run"]) == 0
    assert files(tmp_path) == set()
    assert capsys.readouterr().out.count("would write") == len(ALL)
    assert main(["service", "install", "--root", str(tmp_path)]) == 0
    assert main(["service", "uninstall", "--root", str(tmp_path), "--dry-run", "--purge"]) == 0
    assert files(tmp_path) == ALL
    assert capsys.readouterr().out.count("would delete") == len(ALL)


def test_bad_input_is_refused_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["service", "install", "--root", str(tmp_path / "none")]) == 2
    assert "no such folder" in capsys.readouterr().err
    (tmp_path / "a b").mkdir()
    for name in ("tactiled", "reachd"):
        (tmp_path / "a b" / name).touch()
    words = ["service", "install", "--root", str(tmp_path), "--bin", str(tmp_path / "a b")]
    assert main(words) == 3
    assert "install it elsewhere" in capsys.readouterr().err


@pytest.mark.parametrize("unit", UNITS)
def test_units_have_the_settings_for_unattended_use(root: Path, unit: str) -> None:
    text = (root / "etc/systemd/system" / unit).read_text(encoding="utf-8")
    said = dict(line.split("=", 1) for line in text.splitlines() if "=" in line and line[0] != "#")
    assert "@" not in text.replace("~@privileged", "").replace("@system-service", "")
    assert said["Type"] == "notify"
    assert float(said["WatchdogSec"]) > 0
    assert said["Restart"] == "on-failure"
    assert said["User"] == "tactile"
    assert said["ProtectSystem"] == "strict"
    assert said["CapabilityBoundingSet"] == ""
    assert said["DevicePolicy"] == "closed"
    assert said["RuntimeDirectoryMode"] == "0750"
    assert said["RuntimeDirectoryPreserve"] == "yes"
    assert said["StateDirectory"] == "tactile"
    program = Path(said["ExecStart"].split()[0])
    assert program.exists(), program
    assert "--target" not in said["ExecStart"]  # it would arm by itself after a restart
    if unit == "reachd.service":
        assert int(said["LimitRTPRIO"]) > 0
        assert "--serve" in said["ExecStart"]
        assert "target" not in (root / "etc/tactile/reachd.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("unit", UNITS)
def test_systemd_accepts_the_units_with_low_exposure(root: Path, unit: str) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze, which comes with systemd")
    path = root / "etc/systemd/system" / unit

    def analyze(*words: str) -> str:
        done = subprocess.run(
            ["systemd-analyze", *words, str(path)],
            check=False, capture_output=True, text=True, timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    assert analyze("verify", "--man=no").strip() == ""
    judged = re.search(r"exposure level for .*: ([\d.]+)", analyze("security", "--offline=true"))
    assert judged is not None
    assert float(judged[1]) < ALLOWED_EXPOSURE


def test_udev_rules_are_valid(root: Path) -> None:
    text = (root / "etc/udev/rules.d/70-tactile.rules").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line and line[0] != "#"]
    assert lines
    for line in lines:
        for part in line.split(", "):
            assert RULE.match(part), part
    assert any('GROUP="tactile"' in line and 'MODE="0660"' in line for line in lines)
    labels = set(re.findall(r'LABEL="(\w+)"', text))
    assert set(re.findall(r'GOTO="(\w+)"', text)) <= labels


def test_installed_configurations_are_accepted_by_the_daemons(root: Path) -> None:
    skin = load_toml(root / "etc/tactile/tactiled.toml", SkinConfig)
    assert skin.board[0].port == "/dev/ttyACM0"
    assert skin.log.recorder.max_bytes == 32 << 30
    reach = load_toml(root / "etc/tactile/reachd.toml", ReachConfig)
    assert reach.target is None
    assert reach.log.destination == skin.log.destination == "/var/lib/tactile/logs"
