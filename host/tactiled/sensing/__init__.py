"""The sensing core: field to force to contact features. Pure."""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["off", "ransac", "consensus"]
"""How the ambient field is removed. Defined here so that command lines need not load the core."""

METHODS: tuple[Method, ...] = get_args(Method)
