"""``tactile service``: install and remove units, udev rules and configurations."""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from tactile_core.cli import DONE, REFUSED, CommandError

CONFIGURATION = Path("etc/tactile")
PLACES = {
    "tactiled.service": Path("etc/systemd/system"),
    "reachd.service": Path("etc/systemd/system"),
    "tactile.sysusers": Path("etc/sysusers.d"),
    "70-tactile.rules": Path("etc/udev/rules.d"),
    "tactiled.toml": CONFIGURATION,
    "reachd.toml": CONFIGURATION,
}
"""Files to install, and their folders below the root."""

NAMES = {"tactile.sysusers": "tactile.conf"}
"""Names of installed files, where they differ."""

UNITS = ("tactiled.service", "reachd.service")


@dataclass(frozen=True)
class Plan:
    """Where to install, and which programs the units start."""

    root: Path
    programs: Path
    dry: bool = False

    @property
    def live(self) -> bool:
        """Whether this is the running system, so that its managers must be told."""
        return self.root == Path("/") and not self.dry

    def target(self, name: str) -> Path:
        """Path at which a file is installed."""
        return self.root / PLACES[name] / NAMES.get(name, name)

    def text(self, name: str) -> str:
        """Text of an installed file."""
        text = files("tactile_tools.operate.deploy").joinpath(name).read_text(encoding="utf-8")
        at_home = self.programs.is_relative_to("/home") or self.programs.is_relative_to("/root")
        return (
            text.replace("@BIN@", str(self.programs))
            # Programs in somebody's home must be readable; nothing there is writable either way.
            .replace("@PROTECT_HOME@", "read-only" if at_home else "yes")
        )


def install(options: argparse.Namespace) -> int:
    """``tactile service install``."""
    return _guarded(_install, options)


def uninstall(options: argparse.Namespace) -> int:
    """``tactile service uninstall``."""
    return _guarded(_uninstall, options)


def _guarded(work: Callable[[argparse.Namespace], object], options: argparse.Namespace) -> int:
    if not options.root.is_dir():
        raise CommandError(f"--root {options.root}: no such folder")
    try:
        work(options)
    except PermissionError as error:
        raise CommandError(
            f"{error.filename}: {error.strerror}; run it as root, or with --root", REFUSED
        ) from error
    except OSError as error:
        raise CommandError(f"{error.filename}: {error.strerror}", REFUSED) from error
    return DONE


def _install(options: argparse.Namespace) -> None:
    programs = (options.bin or Path(sys.argv[0]).parent).absolute()
    if not (programs / "tactiled").exists():
        programs = Path(sys.executable).parent
    missing = [name for name in ("tactiled", "reachd") if not (programs / name).exists()]
    if missing:
        raise CommandError(f"{programs} has no {missing[0]}: name their folder with --bin", REFUSED)
    if any(c in str(programs) for c in " \t%$\"'\\"):
        raise CommandError(
            f"{programs}: a unit cannot name this path; install it elsewhere", REFUSED
        )
    plan = Plan(options.root, programs, options.dry_run)
    for name, folder in PLACES.items():
        target = plan.target(name)
        if folder == CONFIGURATION and target.exists():
            print(f"kept     {target}")
            continue
        print(f"{'would write' if plan.dry else 'wrote   '} {target}")
        if not plan.dry:
            target.parent.mkdir(parents=True, exist_ok=True)
            _write(target, plan.text(name))
    if plan.live:
        _notify_managers(
            ["systemd-sysusers"],
            ["systemctl", "daemon-reload"],
            ["udevadm", "control", "--reload"],
            ["udevadm", "trigger", "--subsystem-match=tty"],
        )
    print(
        "Next: name the boards in /etc/tactile/tactiled.toml, then\n"
        "  sudo usermod -aG tactile $USER     # each user who works with them\n"
        "  sudo systemctl enable --now tactiled reachd\n"
        "  tactile health"
    )


def _uninstall(options: argparse.Namespace) -> None:
    plan = Plan(options.root, Path("/"), options.dry_run)
    if plan.live:
        _notify_managers(["systemctl", "disable", "--now", *UNITS])
    for name, folder in PLACES.items():
        target = plan.target(name)
        if not target.exists():
            continue
        if folder == CONFIGURATION and not options.purge:
            print(f"kept     {target} (--purge deletes it)")
            continue
        print(f"{'would delete' if plan.dry else 'deleted '} {target}")
        if not plan.dry:
            target.unlink()
    folder = plan.root / CONFIGURATION
    if options.purge and not plan.dry and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    if plan.live:
        _notify_managers(["systemctl", "daemon-reload"], ["udevadm", "control", "--reload"])
    print("Logs in /var/lib/tactile and the user tactile are left as they are.")


def _write(path: Path, text: str) -> None:
    new = path.with_name(f".{path.name}.new")
    new.write_text(text, encoding="utf-8")
    new.chmod(0o644)
    os.replace(new, path)


def _notify_managers(*commands: Iterable[str]) -> None:
    """Run commands that notify the system's managers; those not installed are reported and
    skipped."""
    for words in commands:
        line = list(words)
        if shutil.which(line[0]) is None:
            print(f"left out {' '.join(line)}: {line[0]} is not installed")
            continue
        done = subprocess.run(line, check=False, capture_output=True, text=True)
        if done.returncode != 0:
            output = (done.stderr or done.stdout).strip().splitlines()
            print(f"failed   {' '.join(line)}: {output[-1] if output else done.returncode}")
