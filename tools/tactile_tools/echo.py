"""``tactile echo``: print the messages of a key as JSON lines, or as raw CDR."""

from __future__ import annotations

import argparse
import json
import struct
import sys
import time

import zenoh

from tactile_core.bus.messages import DecodeError, codec
from tactile_reach.client import Stream, type_of
from tactile_tools import watching
from tactile_tools.log.decode import Decoder, finite
from tactile_tools.log.stream import Stream as LogStream

QUEUE = 4096
"""Messages that wait for a slow terminal; those that do not fit are counted and reported at the
end."""

LENGTH = struct.Struct("<I")
"""Precedes each message of ``--cdr``: its length in bytes."""


def echo(options: argparse.Namespace) -> int:
    """Print messages until stopped, until ``count`` were printed or until ``timeout`` is over."""
    decoder, schemas = Decoder(), {}
    with watching.open_bus(options) as bus:
        stream = Stream(bus.session, options.key, lambda sample: sample, queue=QUEUE)
        printed, since, told = 0, time.monotonic(), False
        while options.count is None or printed < options.count:
            sample = stream.get(0.2)
            if sample is None:
                quiet = time.monotonic() - since
                if options.timeout is not None and quiet > options.timeout:
                    watching.report_silence("echo", options.key)
                    return watching.REFUSED
                if not told and not printed and quiet > watching.QUIET_S:
                    watching.report_silence("echo", options.key)
                    told = True
                continue
            since = time.monotonic()
            data = sample.payload.to_bytes()
            if options.cdr:
                sys.stdout.buffer.write(LENGTH.pack(len(data)) + data)
                sys.stdout.buffer.flush()
                printed += 1
                continue
            try:
                msgtype = type_of(sample)
                if msgtype not in schemas:
                    schemas[msgtype] = _as_stream(sample, msgtype)
                plain = finite(decoder.plain(schemas[msgtype], data))
            except (DecodeError, ValueError) as error:
                plain = {"undecodable": str(error), "bytes": len(data)}
            line = {"key": str(sample.key_expr)} | plain
            print(json.dumps(line, ensure_ascii=False), flush=True)
            printed += 1
        lost = stream.dropped + stream.refused
        if lost:
            print(f"tactile echo: {lost} messages came too fast to be printed", file=sys.stderr)
    return watching.DONE


def _as_stream(sample: zenoh.Sample, msgtype: str) -> LogStream:
    schema = codec().schema(msgtype)
    return LogStream(str(sample.key_expr), msgtype, schema.encoding, schema.data, "cdr")
