"""The wheel installs into a clean environment: every command starts, and all packages are ours."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.support.paths import ROOT

COMMANDS = ("tactiled", "reachd", "armd", "simdevice", "tactile")
TOP_LEVEL = {
    "sensor_proto", "sim_device", "tactile_core", "tactile_reach", "armd", "tactiled", "reachd",
    "tactile_tools",
}  # fmt: skip


def run(*words: str | Path, **kwargs: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(w) for w in words], capture_output=True, text=True, check=False, **kwargs
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheel built from tracked files only, so that a forgotten file is noticed."""
    source = tmp_path_factory.mktemp("source")
    listed = run("git", "-C", ROOT, "ls-files", "-z").stdout.split("\0")
    for name in filter(None, listed):
        if (ROOT / name).is_file():
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    out = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, source)
    return next(out.glob("*.whl"))


def test_wheel_holds_only_our_packages(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == TOP_LEVEL
    assert "sensor_proto/PROTOCOL.md" in names
    assert "tactile_core/bus/msg/ContactFeatures.msg" in names
    assert "tactile_tools/view/page/index.html" in names
    assert not [name for name in names if name.startswith("tactile_tools/dev/")]


def test_every_command_starts_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    home = tmp_path / "env"
    run(sys.executable, "-m", "venv", "--without-pip", home)
    python = home / "bin" / "python"
    site = Path(
        run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").stdout.strip()
    )
    run(
        sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps",
        "--disable-pip-version-check", "--no-index", wheel,
    )  # fmt: skip
    installed = {p.name for p in site.iterdir() if not p.name.endswith(".dist-info")}
    assert installed == TOP_LEVEL
    # The dependencies are already resolved for the environment of this test.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for command in COMMANDS:
        for flag in ("--help", "--version"):
            done = run(home / "bin" / command, flag, cwd=tmp_path)
            assert done.stdout.strip(), f"{command} {flag} says nothing"
    tools = run(home / "bin" / "tactile", "--help").stdout
    for tool in ("log", "plot", "reach", "bench", "demo", "demo-skin", "fuzz"):
        assert tool in tools
        assert run(home / "bin" / "tactile", tool, "--help").stdout.strip()
    words = [home / "bin" / "tactile", "fuzz", "--frames", "1"]
    refused = subprocess.run(words, capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "run it in a checkout" in refused.stderr
