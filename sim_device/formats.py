"""How simulated AnySkin boards write their samples: as people's sketches do, or by a layout."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sensor_proto.anyskin import encode_anyskin
from sensor_proto.layout import FORM, Layout
from sensor_proto.packets import FloatSamples, TaxelStatus

Writer = Callable[[FloatSamples, int], bytes]
"""Bytes of one frame; the number counts frames."""

BANNER = (
    b"I2C scan complete.\r\nFound MLX candidates: 0xC 0xD 0xE 0xF 0x10 \r\n"
    b"Init MLX[0] @0xC status=0\r\nStreaming order: 0xC 0xD 0xE 0xF 0x10 \r\n"
)
"""What firmware prints before its frames, and (`REMARK`) now and then between them."""

REMARK = b"loop time 8123 us, errors 0\r\n"
REMARK_EVERY = 50


def writer_of(name: str, chips: int) -> Writer:
    """Writer by the name of a sketch or by a layout; ValueError names what there is."""
    if name in SKETCHES:
        return SKETCHES[name]
    if ":" not in name:
        raise ValueError(
            f"format {name!r} given; allowed: {', '.join(SKETCHES)}, or a layout: {FORM}"
        )
    layout = Layout.parse(name)
    if layout.chips != chips:
        raise ValueError(f"format {name!r} is of {layout.chips} chips, the board has {chips}")
    return layout.encode


def _rows(samples: FloatSamples) -> list[tuple[float, float, float, float]]:
    """(t, x, y, z) of each chip."""
    values = np.column_stack([samples.temperature_c, samples.field_ut]).tolist()
    return [(t, x, y, z) for t, x, y, z in values]


def _anyskin(samples: FloatSamples, number: int) -> bytes:
    del number
    return encode_anyskin(samples)


def _anyskin_text(samples: FloatSamples, number: int) -> bytes:
    """Nothing stands between the last number of a chip and the first of the next."""
    del number
    return b"".join(b"%.2f\t%.2f\t%.2f\t%.2f" % row for row in _rows(samples)) + b"\r\n"


def _reskin_text(samples: FloatSamples, number: int) -> bytes:
    del number
    return (
        b"".join(b"%.2f\t%.2f\t%.2f\t%.2f\t" % (x, y, z, t) for t, x, y, z in _rows(samples))
        + b"\r\n"
    )


def _eflesh_text(samples: FloatSamples, number: int) -> bytes:
    del number
    chips = (
        b"%d:%.6f:%.6f:%.6f:%.6f" % (i, x, y, z, t) for i, (t, x, y, z) in enumerate(_rows(samples))
    )
    return b"\t".join(chips) + b"\r\n"


def _touch_text(samples: FloatSamples, number: int) -> bytes:
    del number
    chips = [
        b"[S%d:ERR] " % (i + 1)
        if samples.status[i] & TaxelStatus.READ_FAILED
        else b"[S%d:%.1f,%.1f,%.1f] " % (i + 1, x, y, z)
        for i, (_, x, y, z) in enumerate(_rows(samples))
    ]
    return b"FRAME: " + b"".join(chips) + b"\r\n"


def _labels_text(samples: FloatSamples, number: int) -> bytes:
    del number
    chips = (
        b"X%d: %.2f\tY%d: %.2f\tZ%d: %.2f" % (i, x, i, y, i, z)
        for i, (_, x, y, z) in enumerate(_rows(samples))
    )
    return b"\t".join(chips) + b"\r\n"


def _adafruit_text(samples: FloatSamples, number: int) -> bytes:
    """A line for each axis, of the first chip alone."""
    del number
    _, x, y, z = _rows(samples)[0]
    return b"X: %.4f uT\r\nY: %.4f uT\r\nZ: %.4f uT\r\n" % (x, y, z)


SKETCHES: dict[str, Writer] = {
    "anyskin": _anyskin,
    "anyskin-text": _anyskin_text,
    "reskin-text": _reskin_text,
    "eflesh-text": _eflesh_text,
    "touch-text": _touch_text,
    "labels-text": _labels_text,
    "adafruit-text": _adafruit_text,
}
"""``anyskin`` is the usual one; the others follow what public firmware prints."""
