"""Parse NAME=VALUE arguments."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any


def named_values(option: str, given: Iterable[str]) -> dict[str, Any]:
    """Values by name; numbers, true, false and lists as in JSON, anything else as text.

    ValueError shows what was given.
    """
    values: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise ValueError(f"{option} {text!r} is not NAME=VALUE")
        try:
            values[name.strip()] = json.loads(value)
        except json.JSONDecodeError:
            values[name.strip()] = value
    return values
