"""``tactile service``: units, udev rules and configurations, put in place and taken away."""

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

OK, REFUSED = 0, 3

CONFIGURATION = Path("etc/tactile")
PLACES = {
    "tactiled.service": Path("etc/systemd/system"),
    "reachd.service": Path("etc/systemd/system"),
    "tactile.sysusers": Path("etc/sysusers.d"),
    "70-tactile.rules": Path("etc/udev/rules.d"),
    "tactiled.toml": CONFIGURATION,
    "reachd.toml": CONFIGURATION,
}
"""Our files and the folders they go to, below the root."""

NAMES = {"tactile.sysusers": "tactile.conf"}
"""Names they have there, where they differ."""

UNITS = ("tactiled.service", "reachd.service")


class ServiceProblem(Exception):  # noqa: N818 - a refusal, with its remedy
    """The system does not allow what was asked for."""


@dataclass(frozen=True)
class Plan:
    """Where to install, and which programs the units start."""

    root: Path
    programs: Path
    dry: bool = False

    @property
    def live(self) -> bool:
        """Whether this is the running system, whose managers must be told."""
        return self.root == Path("/") and not self.dry

    def target(self, name: str) -> Path:
        """Where a file of ours goes."""
        return self.root / PLACES[name] / NAMES.get(name, name)

    def text(self, name: str) -> str:
        """What goes there."""
        text = files("tactile_tools.operate.deploy").joinpath(name).read_text(encoding="utf-8")
        at_home = self.programs.is_relative_to("/home") or self.programs.is_relative_to("/root")
        return (
            text.replace("@BIN@", str(self.programs))
            # Programs in somebody's home must be readable; nothing there is writable either way.
            .replace("@PROTECT_HOME@", "read-only" if at_home else "yes")
        )


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``service`` to the umbrella command."""
    parser = subparsers.add_parser(
        "service",
        help="install tactiled and reachd as systemd services, or take them away",
        description="Installs units, udev rules, a user and first configurations, or takes them "
        "away; how to run them: docs/operations.md. Needs root, unless --root or --dry-run is "
        "given.",
    )
    tools = parser.add_subparsers(dest="service_tool", metavar="TOOL", required=True)
    install = tools.add_parser("install", help="put the files in place; nothing is started")
    remove = tools.add_parser("uninstall", help="stop the services and delete the files")
    for tool, what in ((install, "written"), (remove, "deleted")):
        tool.add_argument(
            "--root",
            type=Path,
            default=Path("/"),
            metavar="DIR",
            help="folder to take for the root of the system (default /)",
        )
        tool.add_argument(
            "--dry-run", action="store_true", help=f"say what would be {what}, and do nothing"
        )
    install.add_argument(
        "--bin",
        type=Path,
        metavar="DIR",
        help="folder of tactiled and reachd (default: where this command is)",
    )
    install.set_defaults(func=lambda options: _guarded(_install, options))
    remove.add_argument(
        "--purge", action="store_true", help="delete configurations in /etc/tactile as well"
    )
    remove.set_defaults(func=lambda options: _guarded(_uninstall, options))


def _guarded(work: Callable[[argparse.Namespace], object], options: argparse.Namespace) -> int:
    if not options.root.is_dir():
        print(f"tactile service: --root {options.root}: there is no such folder", file=sys.stderr)
        return 2
    try:
        work(options)
    except ServiceProblem as problem:
        print(f"tactile service: {problem}", file=sys.stderr)
        return REFUSED
    except PermissionError as error:
        print(
            f"tactile service: {error.filename}: {error.strerror}; run it as root, or with --root",
            file=sys.stderr,
        )
        return REFUSED
    except OSError as error:
        print(f"tactile service: {error.filename}: {error.strerror}", file=sys.stderr)
        return REFUSED
    return OK


def _install(options: argparse.Namespace) -> None:
    programs = (options.bin or Path(sys.argv[0]).parent).absolute()
    if not (programs / "tactiled").exists():
        programs = Path(sys.executable).parent
    missing = [name for name in ("tactiled", "reachd") if not (programs / name).exists()]
    if missing:
        raise ServiceProblem(f"{programs} has no {missing[0]}: name their folder with --bin")
    if any(c in str(programs) for c in " \t%$\"'\\"):
        raise ServiceProblem(f"{programs}: a unit cannot name this path; install it elsewhere")
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
        _tell(
            ["systemd-sysusers"],
            ["systemctl", "daemon-reload"],
            ["udevadm", "control", "--reload"],
            ["udevadm", "trigger", "--subsystem-match=tty"],
        )
    print(
        "Next: name the boards in /etc/tactile/tactiled.toml, then\n"
        "  sudo usermod -aG tactile $USER     # whoever is to speak with them\n"
        "  sudo systemctl enable --now tactiled reachd\n"
        "  tactile health"
    )


def _uninstall(options: argparse.Namespace) -> None:
    plan = Plan(options.root, Path("/"), options.dry_run)
    if plan.live:
        _tell(["systemctl", "disable", "--now", *UNITS])
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
        _tell(["systemctl", "daemon-reload"], ["udevadm", "control", "--reload"])
    print("Logs in /var/lib/tactile and the user tactile are left as they are.")


def _write(path: Path, text: str) -> None:
    new = path.with_name(f".{path.name}.new")
    new.write_text(text, encoding="utf-8")
    new.chmod(0o644)
    os.replace(new, path)


def _tell(*commands: Iterable[str]) -> None:
    """Run what the managers of the system need to hear; what is not there is said and left out."""
    for words in commands:
        line = list(words)
        if shutil.which(line[0]) is None:
            print(f"left out {' '.join(line)}: there is no {line[0]}")
            continue
        done = subprocess.run(line, check=False, capture_output=True, text=True)
        if done.returncode != 0:
            said = (done.stderr or done.stdout).strip().splitlines()
            print(f"failed   {' '.join(line)}: {said[-1] if said else done.returncode}")
