"""CAN error frames in the layout of SocketCAN (linux/can/error.h): what they mean, and making them.

Every medium's way of telling an error (SocketCAN frames, the ``s`` and ``e`` lines of slcan
adapters) is brought into this one layout, so that there is one place that gives it a name.
"""

from __future__ import annotations

from enum import StrEnum

from sensor_proto.canseg import CanFrame


class BusState(StrEnum):
    """Fault confinement of ISO 11898-1, as the adapter tells; a serial line is always ACTIVE."""

    ACTIVE = "active"
    WARNING = "error-warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


TX_TIMEOUT = 0x001
LOST_ARBITRATION = 0x002
CONTROLLER = 0x004
PROTOCOL = 0x008
TRANSCEIVER = 0x010
NO_ACK = 0x020
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100

_CLASSES = {
    TX_TIMEOUT: "tx-timeout",
    LOST_ARBITRATION: "lost-arbitration",
    PROTOCOL: "protocol-violation",
    TRANSCEIVER: "transceiver",
    NO_ACK: "no-acknowledgement",
    BUS_OFF: "bus-off",
    BUS_ERROR: "bus-error",
    RESTARTED: "restarted",
}

_CONTROLLER_BITS = {
    0x01: "rx-overflow",
    0x02: "tx-overflow",
    0x0C: "error-warning",
    0x30: "error-passive",
    0x40: "error-active",
}

_CONTROLLER_STATE = {
    BusState.ACTIVE: 0x40,
    BusState.WARNING: 0x0C,
    BusState.PASSIVE: 0x30,
}


def error_frame(error_class: int, controller: int = 0, protocol: int = 0) -> CanFrame:
    """Error frame of these class bits; ``controller`` is its data[1], ``protocol`` its data[2]."""
    return CanFrame(error_class, bytes([0, controller, protocol, 0, 0, 0, 0, 0]), error=True)


def state_frame(state: BusState) -> CanFrame:
    """Error frame that announces ``state``."""
    if state is BusState.BUS_OFF:
        return error_frame(BUS_OFF)
    return error_frame(CONTROLLER, _CONTROLLER_STATE[state])


def names(frame: CanFrame) -> tuple[str, ...]:
    """Names of everything an error frame tells; never empty."""
    told = [name for bit, name in _CLASSES.items() if frame.identifier & bit]
    if frame.identifier & CONTROLLER:
        told += [name for bits, name in _CONTROLLER_BITS.items() if _controller(frame) & bits]
    return tuple(told) or ("unspecified",)


def told_state(frame: CanFrame) -> BusState | None:
    """State that an error frame announces; None when it tells of none."""
    if frame.identifier & BUS_OFF:
        return BusState.BUS_OFF
    if frame.identifier & RESTARTED:
        return BusState.ACTIVE
    if frame.identifier & CONTROLLER:
        bits = _controller(frame)
        if bits & 0x30:
            return BusState.PASSIVE
        if bits & 0x0C:
            return BusState.WARNING
        if bits & 0x40:
            return BusState.ACTIVE
    return None


def _controller(frame: CanFrame) -> int:
    return frame.data[1] if len(frame.data) > 1 else 0
