"""The rest field as a log keeps it, so that a later file of the log can be run by itself."""

from __future__ import annotations

import msgspec


class RecordedRest(msgspec.Struct, frozen=True):
    """What taring has found. ``rest_ut``: µT, by array, axis and taxel (padded to the widest).

    ``unrested``: taxels without a rest field; ``noise_ut``: of one sample, three axes; ``rough``:
    it was taken while the skin moved. ``bare``: taxels that have lost their magnet. ``rested_c``:
    °C at which it was taken, by array and taxel; empty where that is not known.
    """

    rest_ut: list[list[list[float]]]
    unrested: list[list[bool]]
    noise_ut: list[float]
    rough: bool = False
    bare: list[list[bool]] = []
    rested_c: list[list[float]] = []
