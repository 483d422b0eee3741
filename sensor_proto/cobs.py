"""Consistent overhead byte stuffing (Cheshire & Baker 1999): no zero inside, at most 1 in 254 more.

Frames are without their ending zero here; `framing` adds and removes it.
"""

from __future__ import annotations

_CODES = tuple(bytes([n]) for n in range(256))
_RUN = b"\1" * 8  # as many zeros, stuffed: shorter runs cost more to look for than to step through
_FULL = 254  # data bytes of the longest block; its code 255 stands for no zero after them


def max_encoded(size: int) -> int:
    """Longest encoding of ``size`` bytes."""
    return size + 1 + size // _FULL


def encode(data: bytes) -> bytes:
    """Stuffed form of ``data``, free of zeros."""
    out: list[bytes] = []
    blocks = data.split(b"\0")
    for block in blocks:
        rest = block
        while len(rest) >= _FULL:
            out += (b"\xff", rest[:_FULL])
            rest = rest[_FULL:]
        out += (_CODES[len(rest) + 1], rest)
    last = blocks[-1]
    if last and len(last) % _FULL == 0:
        # Data that ends in a full block needs no further, empty one.
        del out[-2:]
    return b"".join(out)


def decode(frame: bytes) -> bytes | None:
    """Data of a frame that holds no zero; None when its blocks do not end where it ends.

    Works in place: a block's code byte is where the zero before that block belongs.
    """
    size = len(frame)
    out = bytearray(frame)
    at = 0
    if size <= _FULL + 1:
        # A full block cannot be followed by another here, so that no code needs removing.
        run = frame.find(_RUN)
        stop = size if run < 0 else run
        while at < stop:
            code = out[at]
            out[at] = 0
            at += code
        if at < size:
            # Clear status bits make a long run of zeros: where a code is 1, so are those after it.
            ones = size - at - len(frame[at:].lstrip(b"\1"))
            out[at : at + ones] = bytes(ones)
            at += ones
            while at < size:
                code = out[at]
                out[at] = 0
                at += code
        return bytes(out[1:]) if at == size and size else None
    surplus: list[int] = []
    while at < size:
        code = out[at]
        out[at] = 0
        at += code
        if code > _FULL and at < size:
            surplus.append(at)
    if at != size:
        return None
    for position in reversed(surplus):
        del out[position]
    return bytes(out[1:])
