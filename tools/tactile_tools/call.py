"""``tactile call``: call any service of a daemon and print its reply."""

from __future__ import annotations

import argparse
import json
from typing import Any

from tactile_tools import watching

TIMEOUT_S = 5.0


def call(options: argparse.Namespace) -> None:
    """Call the service and print the reply."""
    with watching.open_bus(options) as bus:
        reply = bus.call(options.key, options.request, timeout_s=options.timeout)
    print(json.dumps(reply, indent=2, ensure_ascii=False))


def _json(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a JSON object, as in '{{\"force\": true}}'"
        )
    return found
