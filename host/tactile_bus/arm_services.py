"""The services through which every arm, simulated or real, grants its command."""

from __future__ import annotations

import zenoh

from tactile_bus.commanding import ClaimRequest, CommandDesk, Grant, NotGrantedError, Signed
from tactile_bus.instant import monotonic_now
from tactile_bus.services import Service, ServiceError, declare_service
from tactile_bus.topics import service_key


def serve_desk(session: zenoh.Session, arm: str, desk: CommandDesk) -> list[Service]:
    """Serve ``claim`` and ``release`` of the arm called ``arm``."""

    def claim(request: ClaimRequest) -> Grant:
        try:
            return desk.claim(request, monotonic_now())
        except NotGrantedError as error:
            raise ServiceError(
                f"arm {arm!r} is not to be had: {error}; stop that one, or name another --arm"
            ) from error

    def release(request: Signed) -> dict[str, str]:
        try:
            desk.release(request)
        except NotGrantedError as error:
            raise ServiceError(str(error)) from error
        return {"commander": desk.commander}

    return [
        declare_service(session, service_key(arm, "claim", "arm"), claim, ClaimRequest),
        declare_service(session, service_key(arm, "release", "arm"), release, Signed),
    ]
