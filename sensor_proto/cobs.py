"""Consistent overhead byte stuffing (Cheshire & Baker 1999): removes zeros, adds at most 1 in 254.

Frames here lack their ending zero; `framing` adds and removes it.
"""

from __future__ import annotations

_CODES = tuple(bytes([n]) for n in range(256))
_RUN = b"\1" * 8  # eight stuffed zeros; a search for shorter runs costs more than it saves
_FULL = 254  # data bytes of the longest block; its code 255 means that no zero follows them


def max_encoded(size: int) -> int:
    """Largest encoded size of ``size`` bytes."""
    return size + 1 + size // _FULL


def encode(data: bytes) -> bytes:
    """Encode ``data``; the result contains no zeros."""
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
        # Data that ends in a full block needs no empty block after it.
        del out[-2:]
    return b"".join(out)


def decode(frame: bytes) -> bytes | None:
    """Decode a frame without zeros; None if its last block does not end where the frame ends.

    Works in place: a block's code byte stands where the zero before that block belongs.
    """
    size = len(frame)
    out = bytearray(frame)
    at = 0
    if size <= _FULL + 1:
        # No block can follow a full one in a frame this short, so no code byte needs removing.
        run = frame.find(_RUN)
        stop = size if run < 0 else run
        while at < stop:
            code = out[at]
            out[at] = 0
            at += code
        if at < size:
            # Clear status bits give long runs of zeros: if one code is 1, so are those after it.
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
