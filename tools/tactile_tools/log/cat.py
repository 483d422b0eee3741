"""``tactile log cat``: print the messages of a log, one per line."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any, TextIO

from tactile_core.bus.messages import DecodeError
from tactile_core.types import NS_PER_S
from tactile_tools.log.arguments import select
from tactile_tools.log.decode import Decoder, finite
from tactile_tools.log.stream import Reading, Record, read_merged
from tactile_tools.log.terminal import FAULTY, clock_text, complain, json_text, shown

SHOWN = 6
"""Elements of an array that are printed; --json prints all."""


def run(options: argparse.Namespace) -> int:
    """Print messages.

    Returns 0 if all were printed, 1 if some were lost or could not be decoded.
    """
    chosen = select(options)
    decoder, reading = Decoder(), Reading()
    out = sys.stdout
    count = undecoded = 0
    for _, item in read_merged(chosen.logs, reading, None, chosen.wanted, chosen.window):
        if not isinstance(item, Record):
            continue
        if options.limit is not None and count >= options.limit:
            break
        count += 1
        try:
            fields = decoder.plain(item.stream, item.data)
        except DecodeError as error:
            undecoded += 1
            fields = {"error": str(error), "bytes": len(item.data)}
        if options.json:
            _print_json(out, item, fields)
        else:
            _print_line(out, item, fields, chosen.start_ns, options.absolute)
    out.flush()
    if remark := reading.remark():
        complain(f"{remark}; printed what could be read")
    if undecoded:
        complain(f"{undecoded} of {count} messages not decoded")
    return FAULTY if undecoded or reading.lossy else 0


def _print_json(out: TextIO, item: Record, fields: Any) -> None:
    line = {
        "topic": item.stream.topic,
        "type": item.stream.msgtype,
        "log_ns": item.log_ns,
        "publish_ns": item.publish_ns,
        "sequence": item.sequence,
        "message": finite(fields),
    }
    out.write(json_text(line) + "\n")


def _print_line(out: TextIO, item: Record, fields: Any, start_ns: int, absolute: bool) -> None:
    seconds = (item.log_ns - start_ns) / NS_PER_S
    when = clock_text(item.log_ns) if absolute else f"{seconds:12.6f}"
    text = _text(fields)
    if isinstance(fields, dict):
        text = text[1:-1]
    out.write(shown(f"{when} {item.stream.topic}  {text}") + "\n")


def _text(value: Any) -> str:
    """Format a value for reading: six digits, long arrays cut."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        if value.keys() == {"x", "y", "z"}:
            return "(" + ", ".join(map(_text, value.values())) + ")"
        inside = (f"{key}={_text(each)}" for key, each in value.items() if key != "header")
        return "{" + " ".join(inside) + "}"
    if isinstance(value, list):
        shown = ", ".join(map(_text, value[:SHOWN]))
        return f"[{shown}]" if len(value) <= SHOWN else f"[{shown}, … {len(value)} in all]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False) if not value or " " in value else value
    return str(value)
