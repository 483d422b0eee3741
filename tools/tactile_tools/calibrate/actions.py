"""Subcommands of ``tactile calibrate``; exit status 2 and 3 are decided here."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from tactile_core.calibration import (
    BoardCalibration,
    CalibrationError,
    load,
    nominal,
    save,
)
from tactile_core.calibration.file import SUFFIX
from tactile_core.cli import DONE, REFUSED, CommandError, require

if TYPE_CHECKING:
    from tactile_tools.calibrate.evaluate import Judged
    from tactile_tools.calibrate.recording import Recording


class ActionError(CommandError):
    """A command cannot go on; the text names the remedy."""


def guarded(
    run: Callable[[argparse.Namespace], None],
) -> Callable[[argparse.Namespace], int]:
    """Make ``run`` a command: its errors become a `CommandError`."""

    def command(options: argparse.Namespace) -> int:
        from tactile_tools.calibrate.recording import RecordingError

        try:
            run(options)
        except (RecordingError, CalibrationError) as error:
            raise ActionError(str(error)) from error
        return DONE

    return command


def _info(options: argparse.Namespace) -> None:
    from tactile_tools.calibrate.describe import as_dict, as_text

    calibration = load(options.file)
    if options.json:
        print(json.dumps(as_dict(calibration), indent=1))
    else:
        Console(soft_wrap=True).print(as_text(calibration), markup=False, highlight=False)


def _require(options: argparse.Namespace) -> None:
    """Check that the extra ``calibrate`` is installed where it is needed."""
    require("scipy", "sklearn", extra="calibrate")
    if options.report is not None:
        require("matplotlib", extra="calibrate", what="--report")


def _evaluate(options: argparse.Namespace) -> None:
    _require(options)
    from tactile_tools.calibrate.assemble import group
    from tactile_tools.calibrate.evaluate import leave_one_out, tail20
    from tactile_tools.calibrate.fit import require_alike
    from tactile_tools.calibrate.results import as_json, table
    from tactile_tools.calibrate.source import open_recordings

    recordings = open_recordings(options.recordings, options.board, options.measured)
    _check_folder(options.report)
    judged = []
    with _watching() as progress:
        for members in group(recordings):
            if options.split == "tail20":
                judged += tail20(members, progress=progress)
                continue
            if len(members) < 2:
                raise ActionError(
                    f"leave-one-out needs two recordings of {'+'.join(members[0].targets)}, only "
                    f"{members[0].path} is given; add one, or use --split tail20"
                )
            require_alike(members)
            judged += leave_one_out(members, progress=progress)
    if options.report is not None:
        _report(options.report, options.split, judged)
    if options.json:
        print(json.dumps(as_json(options.split, judged), indent=1))
    else:
        Console(width=160 if not sys.stdout.isatty() else None).print(table(options.split, judged))


def _fit(options: argparse.Namespace) -> None:
    _require(options)
    from tactile_tools.calibrate.assemble import board, fitted, group
    from tactile_tools.calibrate.describe import as_text
    from tactile_tools.calibrate.fit import require_alike
    from tactile_tools.calibrate.source import open_recordings

    out: Path = options.out
    if not out.name.endswith(SUFFIX):
        raise ActionError(f"--out {out}; allowed: a name that ends in {SUFFIX}")
    if not out.resolve().parent.is_dir():
        raise ActionError(f"--out {out}: no such folder: {out.parent}; create it", REFUSED)
    if out.is_dir():
        raise ActionError(f"--out {out} is a folder; name a file", REFUSED)
    recordings = open_recordings(options.recordings, options.board, options.measured)
    require_alike(recordings)
    _check_folder(options.report)
    base = _base(options.base, recordings[0])
    serial = options.serial or recordings[0].serial_number
    if not serial:
        raise ActionError(
            f"{recordings[0].path} does not say which board it is of; give --serial, as "
            "tactiled --list-ports shows it"
        )
    if options.serial and recordings[0].serial_number not in ("", options.serial):
        raise ActionError(
            f"--serial {options.serial}, but {recordings[0].path} is of board "
            f"{recordings[0].serial_number}; leave --serial out"
        )
    nets, judged = [], []
    with _watching() as progress:
        for members in group(recordings):
            net, _, tests = fitted(members, progress)
            nets.append(net)
            judged += tests
    calibration = board(base, recordings, nets, serial)
    try:
        save(calibration, out)
    except CalibrationError as error:
        raise ActionError(str(error), REFUSED) from error
    if options.report is not None:
        _report(options.report, "as in the file", judged)
    Console(soft_wrap=True).print(as_text(calibration), markup=False, highlight=False)
    print(f"wrote {out}")


def _base(path: Path | None, recording: Recording) -> BoardCalibration:
    if path is None:
        return recording.calibration or nominal("anyskin", "unknown", recording.taxels)
    base = load(path)
    if base.geometry.taxels != recording.taxels:
        raise ActionError(
            f"--base {path} is of {base.geometry.taxels} taxels, {recording.path} of "
            f"{recording.taxels}; give the calibration of that board"
        )
    return base


def _check_folder(folder: Path | None) -> None:
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ActionError(
            f"--report {folder}: cannot be made ({error.strerror}); name another", REFUSED
        ) from error


def _report(folder: Path, split: str, judged: Sequence[Judged]) -> None:
    from tactile_tools.calibrate.report import write_report

    try:
        page = write_report(folder, split, judged)
    except OSError as error:
        raise ActionError(f"--report {folder}: {error.strerror}; name another", REFUSED) from error
    print(f"wrote {page}", file=sys.stderr)


@contextmanager
def _watching() -> Iterator[Callable[[str], None]]:
    """Show on standard error, in a status line, what is being tried."""
    from sklearn.exceptions import ConvergenceWarning

    console = Console(stderr=True)
    with warnings.catch_warnings(), console.status("reading") as status:
        warnings.simplefilter("ignore", ConvergenceWarning)  # they are few on purpose
        yield lambda text: status.update(f"trying {text}")


def _record(options: argparse.Namespace) -> None:
    from tactile_tools.calibrate.record import record

    record(options)


info = guarded(_info)
evaluate_command = guarded(_evaluate)
fit_command = guarded(_fit)
record_command = guarded(_record)
