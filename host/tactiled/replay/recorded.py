"""What a log says of how its boards were read, so that its bytes can be run again the same way."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Literal

import msgspec

from tactile_bus.can_bus import CanSpec
from tactiled.sensing.pipeline_settings import PipelineSettings
from tactiled.settings import Settings

PIPELINE = "pipeline"
"""Name of the metadata record with the fields of `PipelineSettings`, in JSON."""

PORT_PREFIX = "port:"
"""Names of the records of ports begin so; the name of the port's raw chunks follows."""


class RecordedError(ValueError):
    """A log says something of its making that this program does not know; the text says what."""


@dataclass(frozen=True, slots=True)
class RecordedPort:
    """How one port was read. ``nodes``: names of boards on a CAN bus; ``rate``: Hz that was set.

    ``strict``: boards without a calibration file of their own were refused.
    """

    name: str
    spec: str = ""
    medium: Literal["serial", "can"] = "serial"
    kind: str = "auto"
    baud: int = 115_200
    fd: bool = False
    rate: float | None = None
    strict: bool = False
    nodes: Mapping[int, str] | None = None
    arrays: tuple[int, ...] | None = None


def describe(settings: Settings) -> dict[str, dict[str, str]]:
    """Metadata records of a daemon's log, by name; none for a replay, whose log says it all."""
    if settings.replay:
        return {}
    pipeline = {key: json.dumps(value) for key, value in asdict(settings.pipeline).items()}
    tables = {PIPELINE: pipeline}
    for port in settings.ports:
        fd = port.medium == "can" and CanSpec.parse(port.spec).fd
        tables[PORT_PREFIX + port.name] = {
            "spec": port.spec,
            "medium": port.medium,
            "kind": port.kind,
            "baud": str(port.baud),
            "fd": json.dumps(fd),
            "rate": json.dumps(settings.rate),
            "strict": json.dumps(len(settings.calibrations) >= len(settings.ports)),
            "arrays": json.dumps(port.arrays),
            "nodes": json.dumps({str(node): name for node, name in port.nodes.items()}),
        }
    return tables


def recorded_pipeline(values: Mapping[str, str]) -> PipelineSettings:
    """Settings that a log was made with; `RecordedError` for one that is not known here."""
    known = {field.name for field in fields(PipelineSettings)}
    if strange := set(values) - known:
        raise RecordedError(
            f"the log was made with settings this version does not know ({', '.join(strange)}): "
            "update tactile-reach"
        )
    try:
        table = {key: json.loads(text) for key, text in values.items()}
        return msgspec.convert(table, PipelineSettings)
    except ValueError as error:
        raise RecordedError(f"the log's settings cannot be used: {error}") from error


def recorded_port(name: str, values: Mapping[str, str]) -> RecordedPort:
    """Port ``name`` (without the prefix) of a log; `RecordedError` when its record is none."""
    try:
        nodes = {int(node): text for node, text in json.loads(values["nodes"]).items()}
        arrays = json.loads(values.get("arrays", "null"))  # older logs do not say it
        return RecordedPort(
            name=name,
            spec=values["spec"],
            medium="can" if values["medium"] == "can" else "serial",
            kind=values["kind"],
            baud=int(values["baud"]),
            fd=bool(json.loads(values["fd"])),
            rate=json.loads(values["rate"]),
            strict=bool(json.loads(values["strict"])),
            nodes=nodes,
            arrays=None if arrays is None else tuple(int(n) for n in arrays),
        )
    except (KeyError, ValueError, AttributeError, TypeError) as error:
        raise RecordedError(f"the log's record of port {name!r} is spoilt: {error}") from error
