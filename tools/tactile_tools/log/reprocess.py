"""``tactile log reprocess``: run the pipeline again on the raw bytes of a log."""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_core.cli import progress
from tactile_tools.log.arguments import check_output
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.stream import read_series
from tactile_tools.log.terminal import ToolError, plain_console
from tactile_tools.log.writing import LogOutput

if TYPE_CHECKING:  # the daemon's modules take a while to import, so they are imported where needed
    from tactile_core.calibration import BoardCalibration
    from tactile_tools.log.reprocessing import Known, Reprocessing
    from tactiled.sensing.settings import PipelineSettings

METHODS = ("off", "ransac", "consensus")


def run(options: argparse.Namespace) -> int:
    """Reprocess.

    Returns 0 if the new log was written, 1 if nothing came of the raw bytes.
    """
    from tactile_tools.log.reprocessing import Reprocessing, survey
    from tactiled.rerun import RecordedError

    logs = find_series(options.files)
    if len(logs) != 1:
        raise ToolError(f"{len(logs)} logs given: merge them first, or reprocess one by one")
    series = logs[0]
    source = series.paths[0]
    out = options.out or source.with_name(f"{source.stem}_reprocessed.mcap")
    check_output(out, options.force, logs)
    logging.disable(logging.INFO)  # the messages of the boards are in the log already
    with progress("looking through") as report:
        known = survey(series, report)
    given = [_load(path) for path in options.calibration or ()]
    _check_serials(given, known, series)
    try:
        settings = _settings(options, known)
        work = Reprocessing(known, settings, given)
    except RecordedError as error:
        raise ToolError(str(error)) from error
    with progress("reprocessing") as report, LogOutput(out) as output:
        for item in read_series(series, work.reading, report):
            work.take(item, output)
        work.finish(output)
        work.check(series)
        output.metadata("reprocessed", work.summary(series, given))
    _show(work, out, same=not given and settings == known.settings)
    return 0


def _load(path: Path) -> BoardCalibration:
    from tactile_core.calibration import CalibrationError, load

    try:
        return load(path)
    except CalibrationError as error:
        raise ToolError(str(error)) from error


def _check_serials(given: list[BoardCalibration], known: Known, series: Series) -> None:
    """ToolError for a calibration of a board that is not in the log."""
    for calibration in given:
        if known.serials and calibration.serial_number not in known.serials:
            raise ToolError(
                f"the calibration of board {calibration.serial_number} fits none in {series.name}, "
                f"which holds {', '.join(sorted(known.serials))}"
            )


def _settings(options: argparse.Namespace, known: Known) -> PipelineSettings:
    """Settings of the log, with those that were given in their place."""
    from tactile_core.config import ConfigError, load_toml
    from tactiled.settings import ConfigFile, pipeline_settings

    settings = known.settings
    try:
        if options.config is not None:
            settings = pipeline_settings(load_toml(options.config, ConfigFile))
        changes = {
            "method": options.compensation,
            "compensation_rate_hz": options.compensation_rate,
            "feature_rate_hz": options.feature_rate,
        }
        changes = {name: value for name, value in changes.items() if value is not None}
        return replace(settings, **changes)
    except (ConfigError, ValueError) as error:
        raise ToolError(str(error)) from error


def _show(work: Reprocessing, out: Path, *, same: bool) -> None:
    console = plain_console()
    for text in work.sink.warnings:
        console.print(text)
    compare = work.sink.compare
    for topic in sorted(compare.before.keys() | compare.after.keys()):
        before, after = compare.before.get(topic, 0), compare.after.get(topic, 0)
        console.print(
            f"{topic}: {after} messages, {before} in the log; "
            f"{compare.same.get(topic, 0)} bit for bit the same"
        )
    if not work.exact:
        console.print(
            "the log does not tell all that the ports acted on (an older log, one whose start is "
            "missing, or a gap): capture times are estimated anew"
        )
    if remark := work.reading.remark():
        console.print(f"{remark}: reprocessed what could be read")
    differs = sum(compare.before.values()) - sum(compare.same.values())
    if same and work.exact and differs and not work.reading.unclosed:
        console.print(
            f"{differs} messages differ although nothing was changed: another version of "
            "tactile-reach or numpy made them"
        )
    console.print(f"wrote {out}")
