"""Read and write calibration files: versioned TOML of plain numbers, nothing executable.

Floats are written as their shortest exact decimals, so that loading restores the saved numbers
exactly. The schema below defines what a file may hold; conditions between values (numbers of rows,
right-handed rotations) are checked when the calibration is built.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import (
    MAX_DEGREE,
    MAX_FEATURES,
    MAX_LAYERS,
    MAX_UNITS,
    TARGET_UNITS,
    FeatureMap,
    Figure,
    Layer,
    NetModel,
    NetModelError,
    RestTracker,
)
from tactile_core.calibration.types import (
    ArrayCalibration,
    BoardCalibration,
    CalibrationError,
    yaw_degrees,
)
from tactile_core.config import (
    Celsius,
    ConfigError,
    Degrees,
    Document,
    KeyPath,
    MinusInfinity,
    Seconds,
    allowed_values,
    quoted,
    read_text,
    unit,
)
from tactile_core.geometry import ArrayGeometry, Side

FORMAT_NAME = "tactile-calibration"
FORMAT_VERSION = 3
"""Version 2 added ``[[net]]``, fitted models of the whole contact; 3 ``posed``, for arrays in an
unknown place. A file is written in the oldest version that can express its content."""
SUFFIX = ".cal.toml"
MAX_FILE_BYTES = 64 * 1024 * 1024
"""Largest file in bytes. Four arrays of 128 taxels with every coupling block make about 13 MB of
text."""
WHOLLY_FOREIGN = 1 << 16
"""A calibration must identify itself within this many bytes, as parsing 64 MB of anything else
takes minutes."""
MAX_TAXELS = 128
"""Largest array of the wire protocol."""
ORTHONORMAL_TOLERANCE = 1e-6
"""Largest deviation of a rotation from an orthonormal matrix; more is a typing error."""
MAX_CHANNELS = 3 * 128 * 4
"""Channels of the largest board: four arrays of 128 taxels."""
MAX_TERMS = 64
"""Most time constants or radii; more would not run in time."""
MAX_FIGURES = 100

_SIDES = {side.name.lower(): side for side in Side}

Text = Annotated[str, Meta(min_length=1)]
Two = tuple[float, float]
Three = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]
Coupling = Annotated[
    tuple[int, int, float, float, float, float, float, float, float, float, float],
    allowed_values("[taxel, taxel, 9 numbers]"),
]
Numbers = tuple[float, ...]


class ForceTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[array.force]``: force of a taxel = own block · its field + coupling · others' fields."""

    kind: Annotated[Literal["linear"], Meta(description="relation of force and field")]
    own_n_per_ut: Annotated[
        list[Nine], unit("N/µT"), Meta(description="3 × 3 block of each taxel, row-major")
    ]
    coupling_n_per_ut: Annotated[
        list[Coupling],
        unit("N/µT"),
        Meta(description="taxel of the force, taxel of the field, 3 × 3 block; others are zero"),
    ]


class ArrayTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[array]]``: one array of rows × columns taxels. Vectors in taxel axes, z outward."""

    name: Annotated[Text, Meta(description="name of the array, in printable characters")]
    side: Annotated[Literal["left", "right", "tip"], Meta(description="side of the finger")]
    rows: Annotated[int, Meta(ge=1, le=MAX_TAXELS, description="rows of taxels")]
    columns: Annotated[int, Meta(ge=1, le=MAX_TAXELS, description="taxels per row")]
    posed: Annotated[
        bool, Meta(description="whether the places below are known or (false) a guess")
    ] = True
    position_m: Annotated[
        list[Three], unit("m"), Meta(description="x, y, z of each taxel in `frame`")
    ]
    rotation: Annotated[
        list[Nine], Meta(description="taxel axes to the frame, row-major, of each taxel")
    ]
    surface_m: Annotated[
        list[Two], unit("m"), Meta(description="u, v of each taxel on the unrolled skin")
    ]
    chip_yaw_deg: Annotated[
        tuple[Degrees, ...], unit("°"), Meta(description="rotation of each chip about its z")
    ]
    reference_c: Annotated[Celsius, Meta(description="temperature of `rest_ut`")]
    rest_ut: Annotated[
        list[Three], unit("µT"), Meta(description="field of each taxel, unloaded, at `reference_c`")
    ]
    drift_ut_per_k: Annotated[
        list[Three], unit("µT/K"), Meta(description="change of that field with temperature")
    ]
    force: ForceTable


class RestTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``rest`` of a model: when the skin counts as untouched, and how its rest field follows."""

    near_ut: Annotated[float, unit("µT"), Meta(description="largest distance from the rest field")]
    still_ut: Annotated[
        float, unit("µT"), Meta(description="largest distance from the mean of the last second")
    ]
    tau_s: Annotated[Seconds, Meta(description="time constant of the tracked rest field")]


class LayerTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[net.layer]]``: one layer of the readout; the last one is linear to the targets."""

    kind: Annotated[Literal["linear", "tanh", "rbf"], Meta(description="function of the layer")]
    columns: Annotated[int, Meta(ge=1, le=MAX_FEATURES, description="numbers per row of `weights`")]
    weights: Annotated[
        list[list[float]],
        Meta(max_length=MAX_FEATURES, description="input × output, or the centres of rbf"),
    ]
    bias: Annotated[
        Numbers, Meta(max_length=MAX_UNITS, description="bias of each output; for rbf: gamma")
    ]


class FigureTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[net.figure]]``: one error figure of a model."""

    name: Annotated[Text, Meta(description="name of the figure")]
    value: Annotated[float, Meta(description="value of the figure")]
    unit: Annotated[Text, Meta(description="its unit")]
    how: Annotated[Text, Meta(description="how it was obtained")]


class NetTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[net]]``: a fitted model of the contact as a whole (since version 2)."""

    recipe: Annotated[Text, Meta(description="name of the fit")]
    targets: Annotated[
        tuple[str, ...],
        Meta(min_length=1, description=f"predicted values: {', '.join(TARGET_UNITS)}"),
    ]
    units: Annotated[
        tuple[str, ...], Meta(min_length=1, description="unit of each target: N, or mm for places")
    ]
    floor: Annotated[
        tuple[MinusInfinity, ...], Meta(description="least value of each target, -inf for none")
    ]
    delay_s: Annotated[
        Seconds, Meta(description="delay of the labels behind the field, removed in the fit")
    ]
    rest: RestTable | None = None
    components: Annotated[
        int, Meta(ge=1, le=MAX_CHANNELS, description="numbers per row of `projection`")
    ]
    projection: Annotated[
        list[list[float]],
        unit("1/µT"),
        Meta(max_length=MAX_CHANNELS, description="channels (x, y, z of each taxel) × components"),
    ]
    degree: Annotated[
        int, Meta(ge=1, le=MAX_DEGREE, description="most factors in a product of components")
    ]
    curved: Annotated[int, Meta(ge=0, description="components whose products are features")]
    taus_s: Annotated[
        tuple[Seconds, ...],
        unit("s"),
        Meta(max_length=MAX_TERMS, description="time constants of the leaky integrators"),
    ]
    radii: Annotated[Numbers, Meta(max_length=MAX_TERMS, description="radii of the play operators")]
    lagged: Annotated[int, Meta(ge=0, description="components whose history is a feature")]
    lag_degree: Annotated[
        int, Meta(ge=0, le=3, description="highest power of the first component times history")
    ]
    direction: Annotated[
        bool, Meta(description="whether the direction of the components is a feature")
    ]
    mean: Annotated[Numbers, Meta(max_length=MAX_FEATURES, description="mean of each feature")]
    scale: Annotated[Numbers, Meta(max_length=MAX_FEATURES, description="scale of each feature")]
    layer: Annotated[
        tuple[LayerTable, ...], Meta(min_length=1, max_length=MAX_LAYERS, description="readout")
    ]
    figure: Annotated[
        tuple[FigureTable, ...], Meta(max_length=MAX_FIGURES, description="errors")
    ] = ()


class CalibrationFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A calibration of one board."""

    format: Annotated[Literal["tactile-calibration"], Meta(description="type of the file")]
    format_version: Annotated[
        int, Meta(ge=1, le=FORMAT_VERSION, description="version of the format")
    ]
    serial_number: Annotated[Text, Meta(description="serial number, in printable characters")]
    model: Annotated[Text, Meta(description="model, in printable characters")]
    frame: Annotated[Text, Meta(description="frame of the places, in printable characters")]
    created: Annotated[Text, Meta(description="date and time, ISO 8601")]
    provenance: Annotated[Text, Meta(description="how the figures were obtained")]
    nominal: Annotated[
        bool, Meta(description="whether they are typical figures, not measured on this board")
    ]
    array: Annotated[tuple[ArrayTable, ...], Meta(min_length=1)]
    net: tuple[NetTable, ...] = ()


def save(calibration: BoardCalibration, path: Path | str) -> None:
    """Write ``calibration`` atomically: the old file stays until the new one is complete."""
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
    """Load the file ``path``. A `CalibrationError` names file, line, key and what is allowed."""
    try:
        text = read_text(path, MAX_FILE_BYTES)
    except ConfigError as error:
        raise CalibrationError(f"{error}: a {SUFFIX} file") from error
    return loads(text, str(path))


def saves(calibration: BoardCalibration) -> str:
    """Format a calibration as the text of a file."""
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
        lines += ["", *_net_lines(net)]
    return "\n".join(lines) + "\n"


def loads(text: str, source: str = "calibration") -> BoardCalibration:
    """Parse the text of a calibration file; ``source`` names it in errors."""
    if len(text) > WHOLLY_FOREIGN and FORMAT_NAME not in text[:WHOLLY_FOREIGN]:
        raise CalibrationError(f"{source}: not a calibration: it does not say {FORMAT_NAME!r}")
    try:
        return _calibration(Document.parse(text, source))
    except ConfigError as error:
        raise CalibrationError(str(error)) from error


def _calibration(document: Document) -> BoardCalibration:
    version = document.data.get("format_version")
    if isinstance(version, int) and version > FORMAT_VERSION:
        problem = (
            f"format_version is {version}, newer than {FORMAT_VERSION}, the newest that this "
            f"program reads; update it, or save the calibration in version {FORMAT_VERSION}"
        )
        raise document.error(("format_version",), problem)
    file = document.convert(CalibrationFile)
    for key in ("serial_number", "model", "frame"):
        _check_printable(document, (key,))
    arrays = tuple(_array(document, i, table) for i, table in enumerate(file.array))
    nets = tuple(_net(document, i, table) for i, table in enumerate(file.net))
    try:
        return BoardCalibration(
            file.serial_number,
            file.model,
            file.frame,
            file.created,
            file.provenance,
            file.nominal,
            arrays,
            nets,
        )
    except CalibrationError as error:
        raise document.error((), str(error)) from error


def _version(calibration: BoardCalibration) -> int:
    """Oldest version of the format that can express ``calibration``."""
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
    yield from _matrix_lines("position_m", g.position, "x, y, z of each taxel in the frame above")
    yield from _matrix_lines(
        "rotation", g.rotation.reshape(n, 9), "taxel axes to the frame, row-major"
    )
    yield from _matrix_lines("surface_m", g.surface, "place on the unrolled skin")
    yield f"chip_yaw_deg = [{_row(yaw_degrees(g.chip_yaw))}]"
    yield f"reference_c = {_exact(array.reference_c)}"
    yield from _matrix_lines("rest_ut", array.rest_ut, "unloaded, at reference_c")
    yield from _matrix_lines("drift_ut_per_k", array.drift_ut_per_k, "change with temperature")
    yield "[array.force]"
    yield 'kind = "linear"  # force of a taxel = own block * its field + coupling * others\' fields'
    own = blocks[np.arange(n), np.arange(n)].reshape(n, 9)
    yield from _matrix_lines("own_n_per_ut", own, "3 x 3 of each taxel, row-major")
    yield "coupling_n_per_ut = [  # [force of taxel, field of taxel, 3 x 3 row-major]; others zero"
    for i, j in np.argwhere(blocks.any(axis=(2, 3))).tolist():
        if i != j:
            yield f"  [{i}, {j}, {_row(blocks[i, j].ravel())}],"
    yield "]"


def _net_lines(net: NetModel) -> Iterable[str]:
    """Lines of one fitted model."""
    f = net.features
    yield "[[net]]"
    yield f"recipe = {quoted(net.recipe)}"
    yield f"targets = [{', '.join(quoted(t) for t in net.targets)}]"
    units = ", ".join(quoted(TARGET_UNITS[t]) for t in net.targets)
    yield f"units = [{units}]"
    least = ", ".join("-inf" if math.isinf(v) else _exact(v) for v in net.floor.tolist())
    yield f"floor = [{least}]  # least value of each target"
    delay = _exact(net.delay_s)
    yield f"delay_s = {delay}  # of the labels behind the field, taken out in the fit"
    if f.tracker is not None:
        tracker = f.tracker
        near, still, tau = map(_exact, (tracker.near_ut, tracker.still_ut, tracker.tau_s))
        yield f"rest = {{near_ut = {near}, still_ut = {still}, tau_s = {tau}}}"
    yield f"components = {f.projection.shape[1]}"
    yield from _matrix_lines("projection", f.projection, "x, y, z of each taxel in turn, 1/uT")
    yield f"degree = {f.degree}"
    yield f"curved = {f.curved}"
    yield f"taus_s = [{_row(f.taus_s)}]"
    yield f"radii = [{_row(f.radii)}]"
    yield f"lagged = {f.lagged}"
    yield f"lag_degree = {f.lag_degree}"
    yield f"direction = {'true' if f.direction else 'false'}"
    yield f"mean = [{_row(net.mean)}]"
    yield f"scale = [{_row(net.scale)}]"
    for layer in net.layers:
        yield "[[net.layer]]"
        yield f"kind = {quoted(layer.kind)}"
        yield f"columns = {layer.weights.shape[1]}"
        yield from _matrix_lines("weights", layer.weights, "centres" if layer.kind == "rbf" else "")
        yield f"bias = [{_row(layer.bias)}]"
    for figure in net.figures:
        yield "[[net.figure]]"
        yield f"name = {quoted(figure.name)}"
        yield f"value = {_exact(figure.value)}"
        yield f"unit = {quoted(figure.unit)}"
        yield f"how = {quoted(figure.how)}"


def _matrix_lines(key: str, values: FloatArray, remark: str) -> Iterable[str]:
    """Lines of a list of rows."""
    yield f"{key} = [  # {remark}"
    for row in values:
        yield f"  [{_row(row)}],"
    yield "]"


def _row(values: FloatArray) -> str:
    """Exact decimals of a row, without brackets."""
    return ", ".join(_exact(v) for v in values.tolist())


def _exact(value: float) -> str:
    """Shortest exact decimal."""
    return repr(float(value))


def _check_printable(document: Document, keys: KeyPath) -> None:
    """Reject unprintable text, as messages show these names."""
    if not str(document.value(keys)).isprintable():
        raise document.wrong(keys, "a text of printable characters")


def _array(document: Document, number: int, table: ArrayTable) -> ArrayCalibration:
    at: KeyPath = ("array", number)
    n = table.rows * table.columns
    if n > MAX_TAXELS:
        found = f"{table.rows} x {table.columns} taxels"
        raise document.wrong((*at, "rows"), f"at most {MAX_TAXELS} taxels", found)
    _check_printable(document, (*at, "name"))

    def matrix(key: str, rows: Sequence[Any], inner: KeyPath = ()) -> FloatArray:
        if len(rows) != n:
            keys = (*at, *inner, key)
            raise document.wrong(keys, f"{n} rows, one a taxel", f"{len(rows)} rows")
        return np.array(rows, np.float64)

    rotation = matrix("rotation", table.rotation).reshape(n, 3, 3)
    skew = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max()
    if skew > ORTHONORMAL_TOLERANCE or (np.linalg.det(rotation) < 0).any():
        wanted = "right-handed orthonormal matrices"
        raise document.wrong((*at, "rotation"), wanted, f"matrices off by {skew:.2g}")
    geometry = ArrayGeometry(
        name=table.name,
        side=_SIDES[table.side],
        rows=table.rows,
        columns=table.columns,
        position=matrix("position_m", table.position_m),
        rotation=rotation,
        surface=matrix("surface_m", table.surface_m),
        chip_yaw=np.deg2rad(matrix("chip_yaw_deg", table.chip_yaw_deg)),
        posed=table.posed,
    )
    rest = matrix("rest_ut", table.rest_ut)
    drift = matrix("drift_ut_per_k", table.drift_ut_per_k)
    own = matrix("own_n_per_ut", table.force.own_n_per_ut, ("force",))
    blocks = np.zeros((n, n, 3, 3))
    blocks[np.arange(n), np.arange(n)] = own.reshape(n, 3, 3)
    seen: set[tuple[int, int]] = set()
    for k, row in enumerate(table.force.coupling_n_per_ut):
        here = (*at, "force", "coupling_n_per_ut", k)
        i, j = row[:2]
        if not (0 <= i < n and 0 <= j < n):
            raise document.wrong(here, f"taxels from 0 to {n - 1}", f"{[i, j]}")
        if i == j or (i, j) in seen:
            raise document.wrong(here, "each pair of two different taxels once", f"{[i, j]}")
        seen.add((i, j))
        blocks[i, j] = np.reshape(row[2:], (3, 3))
    full = np.ascontiguousarray(blocks.swapaxes(1, 2).reshape(3 * n, 3 * n))
    return ArrayCalibration(geometry, rest, drift, table.reference_c, full)


def _net(document: Document, number: int, table: NetTable) -> NetModel:
    at: KeyPath = ("net", number)

    def matrix(keys: KeyPath, rows: Sequence[Sequence[float]], columns: int) -> FloatArray:
        for k, row in enumerate(rows):
            if len(row) != columns:
                raise document.wrong((*keys, k), f"{columns} numbers", f"{len(row)} numbers")
        return np.array(rows, np.float64).reshape(len(rows), columns)

    for k, (target, given) in enumerate(zip(table.targets, table.units, strict=False)):
        if TARGET_UNITS.get(target, given) != given:
            raise document.wrong((*at, "units", k), f"{TARGET_UNITS[target]} for {target}")
    rest = table.rest
    try:
        return NetModel(
            table.recipe,
            table.targets,
            FeatureMap(
                None if rest is None else RestTracker(rest.near_ut, rest.still_ut, rest.tau_s),
                matrix((*at, "projection"), table.projection, table.components),
                table.degree,
                table.curved,
                np.array(table.taus_s, np.float64),
                table.lagged,
                table.lag_degree,
                np.array(table.radii, np.float64),
                table.direction,
            ),
            np.array(table.mean, np.float64),
            np.array(table.scale, np.float64),
            tuple(
                Layer(
                    layer.kind,
                    matrix((*at, "layer", k, "weights"), layer.weights, layer.columns),
                    np.array(layer.bias, np.float64),
                )
                for k, layer in enumerate(table.layer)
            ),
            np.array(table.floor, np.float64),
            table.delay_s,
            tuple(Figure(f.name, f.value, f.unit, f.how) for f in table.figure),
        )
    except NetModelError as error:
        raise document.error(at, f"net[{number}]: {error}") from error
