"""Reading and writing calibration files: versioned TOML of plain numbers, nothing executable.

Floats are written as their shortest exact decimals, so a file gives back the very numbers saved.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_core.calibration.force_model_file import net_lines, read_net
from tactile_core.calibration.table import Table, matrix_lines, number, numbers, quoted
from tactile_core.calibration.types import (
    ArrayCalibration,
    BoardCalibration,
    CalibrationError,
    yaw_degrees,
)
from tactile_core.geometry import ArrayGeometry, Side
from tactile_core.toml_text import TomlError, parse, read_text

Float = NDArray[np.float64]

FORMAT_NAME = "tactile-calibration"
FORMAT_VERSION = 3
"""2 added ``[[net]]``, fitted models of the whole contact; 3 ``posed``, for arrays whose place
is not known. A file is written in the oldest version that holds what it says."""
SUFFIX = ".cal.toml"
MAX_FILE_BYTES = 64 * 1024 * 1024
"""Four arrays of 128 taxels with every coupling block come to about 13 MB of text."""
WHOLLY_FOREIGN = 1 << 16
"""Bytes within which a calibration says what it is: 64 MB of what is not take minutes."""
MAX_TAXELS = 128
"""Largest array of the wire protocol."""
ORTHONORMAL_TOLERANCE = 1e-6
"""A rotation may differ this much from an orthonormal matrix: more is a typing error."""

_SIDES = {side.name.lower(): side for side in Side}


def save(calibration: BoardCalibration, path: Path | str) -> None:
    """Write ``calibration`` to ``path``; either the whole file appears or the old one stays."""
    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_text(saves(calibration), encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be written ({error.strerror}); choose a directory you may write to"
        ) from error


def load(path: Path | str) -> BoardCalibration:
    """Calibration in the file ``path``; `CalibrationError` names file, key, given and allowed."""
    try:
        text = read_text(path, MAX_FILE_BYTES)
    except TomlError as error:
        raise CalibrationError(f"{error}: a {SUFFIX} file") from error
    return loads(text, str(path))


def saves(calibration: BoardCalibration) -> str:
    """Text of a calibration file."""
    lines = [
        "# Calibration of one taxel board. Lengths in m, angles in deg, fields in uT, forces in N;",
        "# vectors in taxel axes (z is the outward normal) unless a key says otherwise.",
        f"format = {quoted(FORMAT_NAME)}",
        f"format_version = {_version(calibration)}",
        f"serial_number = {quoted(calibration.serial_number)}",
        f"model = {quoted(calibration.model)}",
        f"frame = {quoted(calibration.frame)}",
        f"created = {quoted(calibration.created)}",
        f"provenance = {quoted(calibration.provenance)}",
        f"nominal = {'true' if calibration.nominal else 'false'}",
    ]
    for array in calibration.arrays:
        lines += ["", *_array_lines(array)]
    for net in calibration.nets:
        lines += ["", *net_lines(net)]
    return "\n".join(lines) + "\n"


def loads(text: str, source: str = "calibration") -> BoardCalibration:
    """Calibration from the text of a file; ``source`` names it in errors."""
    if len(text) > WHOLLY_FOREIGN and FORMAT_NAME not in text[:WHOLLY_FOREIGN]:
        raise CalibrationError(f"{source}: not a calibration: it does not say {FORMAT_NAME!r}")
    try:
        table = parse(text, source)
    except TomlError as error:
        raise CalibrationError(str(error)) from error
    top = Table(source, "", table)
    if top.text("format") != FORMAT_NAME:
        raise top.wrong("format", table["format"], repr(FORMAT_NAME))
    version = top.integer("format_version", 1, 2**31)
    if version > FORMAT_VERSION:
        raise CalibrationError(
            f"{source}: format_version is {version}, newer than {FORMAT_VERSION}, the newest that "
            f"this program reads; update it, or save the calibration in version {FORMAT_VERSION}"
        )
    serial, model, frame = top.word("serial_number"), top.word("model"), top.word("frame")
    created, provenance = top.text("created"), top.text("provenance")
    nominal = top.take("nominal")
    if not isinstance(nominal, bool):
        raise top.wrong("nominal", repr(nominal), "true or false")
    arrays = top.take("array")
    if not isinstance(arrays, list) or not arrays:
        raise top.wrong("array", arrays, "at least one [[array]] table")
    parsed = tuple(_read_array(Table(source, f"array[{i}].", a)) for i, a in enumerate(arrays))
    nets = top.take("net") if "net" in table else []
    if not isinstance(nets, list):
        raise top.wrong("net", nets, "[[net]] tables")
    fitted = tuple(read_net(Table(source, f"net[{i}].", net)) for i, net in enumerate(nets))
    top.done()
    try:
        return BoardCalibration(serial, model, frame, created, provenance, nominal, parsed, fitted)
    except CalibrationError as error:
        raise CalibrationError(f"{source}: {error}") from error


def _version(calibration: BoardCalibration) -> int:
    """Oldest version of the format that holds all that ``calibration`` says."""
    if not all(array.geometry.posed for array in calibration.arrays):
        return 3
    return 2 if calibration.nets else 1


def _array_lines(array: ArrayCalibration) -> Iterable[str]:
    g = array.geometry
    n = g.taxels
    blocks = array.newton_per_ut.reshape(n, 3, n, 3).swapaxes(1, 2)
    yield "[[array]]"
    yield f"name = {quoted(g.name)}"
    yield f"side = {quoted(g.side.name.lower())}"
    yield f"rows = {g.rows}"
    yield f"columns = {g.columns}"
    if not g.posed:
        yield "posed = false  # where it is mounted is not known: the places below are a guess"
    yield from matrix_lines("position_m", g.position, "x, y, z of each taxel in the frame above")
    yield from matrix_lines(
        "rotation", g.rotation.reshape(n, 9), "taxel axes to the frame, row-major"
    )
    yield from matrix_lines("surface_m", g.surface, "place on the unrolled skin")
    yield f"chip_yaw_deg = [{numbers(yaw_degrees(g.chip_yaw))}]"
    yield f"reference_c = {number(array.reference_c)}"
    yield from matrix_lines("rest_ut", array.rest_ut, "unloaded, at reference_c")
    yield from matrix_lines("drift_ut_per_k", array.drift_ut_per_k, "change with temperature")
    yield "[array.force]"
    yield 'kind = "linear"  # force of a taxel = own block * its field + coupling * others\' fields'
    own = blocks[np.arange(n), np.arange(n)].reshape(n, 9)
    yield from matrix_lines("own_n_per_ut", own, "3 x 3 of each taxel, row-major")
    yield "coupling_n_per_ut = [  # [force of taxel, field of taxel, 3 x 3 row-major]; others zero"
    for i, j in np.argwhere(blocks.any(axis=(2, 3))).tolist():
        if i != j:
            yield f"  [{i}, {j}, {numbers(blocks[i, j].ravel())}],"
    yield "]"


def _read_array(table: Table) -> ArrayCalibration:
    name = table.word("name")
    side = table.text("side")
    if side not in _SIDES:
        raise table.wrong("side", side, "one of " + ", ".join(_SIDES))
    rows = table.integer("rows", 1, MAX_TAXELS)
    columns = table.integer("columns", 1, MAX_TAXELS)
    n = rows * columns
    if n > MAX_TAXELS:
        raise table.wrong("rows", f"{rows} x {columns}", f"at most {MAX_TAXELS} taxels")
    rotation = table.matrix("rotation", n, 9).reshape(n, 3, 3)
    skew = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max()
    if skew > ORTHONORMAL_TOLERANCE or (np.linalg.det(rotation) < 0).any():
        raise table.wrong("rotation", f"off by {skew:.2g}", "right-handed orthonormal matrices")
    posed = table.boolean("posed") if table.has("posed") else True
    geometry = ArrayGeometry(
        name=name,
        side=_SIDES[side],
        rows=rows,
        columns=columns,
        position=table.matrix("position_m", n, 3),
        rotation=rotation,
        surface=table.matrix("surface_m", n, 2),
        chip_yaw=np.deg2rad(table.vector("chip_yaw_deg", n)),
        posed=posed,
    )
    reference = table.number("reference_c")
    rest, drift = table.matrix("rest_ut", n, 3), table.matrix("drift_ut_per_k", n, 3)
    force = table.table("force")
    kind = force.text("kind")
    if kind != "linear":
        raise force.wrong("kind", kind, "'linear'")
    blocks = np.zeros((n, n, 3, 3))
    blocks[np.arange(n), np.arange(n)] = force.matrix("own_n_per_ut", n, 9).reshape(n, 3, 3)
    seen: set[tuple[int, int]] = set()
    for at, i, j, block in force.coupling("coupling_n_per_ut", n):
        if i == j or (i, j) in seen:
            raise force.wrong(at, [i, j], "each pair of two different taxels once")
        seen.add((i, j))
        blocks[i, j] = block
    force.done()
    table.done()
    matrix = np.ascontiguousarray(blocks.swapaxes(1, 2).reshape(3 * n, 3 * n))
    return ArrayCalibration(geometry, rest, drift, reference, matrix)
