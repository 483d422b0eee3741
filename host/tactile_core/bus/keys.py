"""Folder of keys with which one process or user joins a rig over TLS.

``ca.pem`` (the lab's own authority), ``cert.pem`` and ``key.pem`` (of this party), ``roles.toml``
(the certificate names of each role). `tactile bus keys` makes them.
"""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from tactile_core.bus.rights import CERTIFICATE_ROLES, CertificateRole
from tactile_core.config import ConfigError, load_toml

CA, CERTIFICATE, PRIVATE_KEY, ROLES = "ca.pem", "cert.pem", "key.pem", "roles.toml"


class KeysError(Exception):
    """The keys cannot be used; the message names the remedy."""


class Roles(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Certificate names of each role; a name in no list has no rights."""

    tactiled: Annotated[
        tuple[str, ...], Meta(description="certificate names of processes that publish boards")
    ] = ()
    reachd: Annotated[
        tuple[str, ...], Meta(description="certificate names of processes that command arms")
    ] = ()
    arm: Annotated[tuple[str, ...], Meta(description="certificate names of arm drivers")] = ()
    operator: Annotated[
        tuple[str, ...], Meta(description="certificate names with all requests allowed")
    ] = ()
    viewer: Annotated[
        tuple[str, ...], Meta(description="certificate names with read access only")
    ] = ()

    def table(self) -> dict[CertificateRole, tuple[str, ...]]:
        """Certificate names by role."""
        return {role: getattr(self, role) for role in CERTIFICATE_ROLES}


class TlsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Mutual TLS: paths of PEM files, and the certificate names of each role (others are refused).

    ``name``: this party's own common name, so that requests it may not make fail at once.
    """

    replaced: ClassVar[dict[str, str]] = {
        "allowed": "name the certificates of each role in [bus.tls.roles], as `tactile bus keys` "
        "does in roles.toml"
    }

    root_ca: Annotated[str, Meta(description="PEM file of the lab's own authority")]
    certificate: Annotated[str, Meta(description="PEM file of this party's certificate")]
    private_key: Annotated[str, Meta(description="PEM file of its private key")]
    roles: Roles
    name: Annotated[str, Meta(description="this party's own common name")] = ""

    def role(self) -> CertificateRole | None:
        """Role of this party's certificate; None if ``name`` is in no list."""
        return next(
            (role for role, names in self.roles.table().items() if self.name in names), None
        )


class RolesFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``roles.toml``."""

    name: Annotated[str, Meta(description="common name of the party the folder is for")] = ""
    roles: Roles


def load_keys(folder: Path | str) -> TlsConfig:
    """Load a folder of keys. Raises `KeysError` if it is incomplete."""
    folder = Path(folder)
    if not folder.is_dir():
        raise KeysError(
            f"--keys {folder}: no such folder; `tactile bus keys` makes one for each party"
        )
    parties = ", ".join(sorted(p.name for p in folder.iterdir() if (p / ROLES).exists()))
    if not (folder / PRIVATE_KEY).exists() and parties:
        raise KeysError(f"--keys {folder}: name the folder of one party in it ({parties})")
    try:
        roles_file = load_toml(folder / ROLES, RolesFile)
    except ConfigError as error:
        raise KeysError(str(error)) from error
    return TlsConfig(
        root_ca=str(folder / CA),
        certificate=str(folder / CERTIFICATE),
        private_key=str(folder / PRIVATE_KEY),
        roles=roles_file.roles,
        name=roles_file.name,
    )


def check_keys(tls: TlsConfig) -> None:
    """Check the key files.

    Raises `KeysError` if one is missing, or if other users of this machine can read the private
    key.
    """
    for path in (tls.root_ca, tls.certificate, tls.private_key):
        try:
            with Path(path).open("rb") as file:
                if not file.read(1):
                    raise KeysError(f"{path} is empty: make the keys again")
        except OSError as error:
            raise KeysError(
                f"{path}: {error.strerror}; name a folder of keys, which `tactile bus keys` makes"
            ) from error
    if Path(tls.private_key).stat().st_mode & stat.S_IRWXO:
        raise KeysError(
            f"every user of this machine can read {tls.private_key}: chmod 0600 {tls.private_key}"
        )
    if not any(tls.roles.table().values()):
        raise KeysError("roles is empty: name the certificates of each role")
