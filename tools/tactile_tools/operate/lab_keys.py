"""Certificate authority of a lab, and a folder of keys for each party of its rigs.

The authority's own key stays in the lab's folder and is needed only to make more keys; nothing that
runs reads it. Every party has its own folder, to be copied to its machine.
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_core.bus.keys import CA, CERTIFICATE, PRIVATE_KEY, ROLES, RolesFile
from tactile_core.bus.rights import CERTIFICATE_ROLES, CertificateRole
from tactile_core.config import ConfigError, load_toml

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.x509 import Certificate, CertificateBuilder, Name

CA_KEY = "ca.key"
"""File of the authority's private key, in the lab's folder."""

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
"""Names of the machine itself, which every daemon's certificate contains."""

SERVER_ROLES: tuple[CertificateRole, ...] = ("tactiled", "reachd", "arm")
"""Roles that others connect to; no other certificate can pass as a server's."""

PARTY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
"""Allowed names of a party: its folder and the common name of its certificate."""

BACKDATED = datetime.timedelta(hours=1)
"""Certificates are valid from this much earlier, for machines whose clocks are behind."""


class LabError(Exception):
    """Keys cannot be made as asked; the message names the remedy."""


@dataclass(frozen=True)
class Order:
    """``parties``: names and roles. ``hosts``: where daemons are reached. ``days``: validity."""

    folder: Path
    parties: Sequence[tuple[str, CertificateRole]]
    hosts: Sequence[str] = ()
    days: float = 825.0
    again: bool = False
    now: datetime.datetime = field(default_factory=lambda: datetime.datetime.now(datetime.UTC))


DEFAULT_PARTIES: tuple[tuple[str, CertificateRole], ...] = tuple(
    (role, role) for role in CERTIFICATE_ROLES
)


def make_keys(order: Order) -> list[Path]:
    """Make the authority if there is none, and a folder for each party. Returns the folders.

    All folders get the new list of roles. `LabError` if a party exists already (unless
    ``again``), a name cannot be used, or `cryptography` is not installed.
    """
    _check(order)
    roles = known_roles(order.folder)
    for name, role in order.parties:
        held = next((r for r, names in roles.items() if name in names and r != role), None)
        if held is not None:
            raise LabError(
                f"{name} has the role {held} already: take another name for the role {role}"
            )
        if (order.folder / name).exists() and not order.again:
            raise LabError(
                f"{order.folder / name} is there already; --again makes new keys for it (the old "
                "certificate stays good until it expires: see docs/security.md)"
            )
        roles[role] = tuple(dict.fromkeys((*roles.get(role, ()), name)))
    order.folder.mkdir(parents=True, exist_ok=True)
    order.folder.chmod(0o700)
    authority = _authority(order)
    made = []
    for name, role in order.parties:
        folder = order.folder / name
        folder.mkdir(exist_ok=True)
        folder.chmod(0o750)
        _party(authority, order, folder, name, role)
        made.append(folder)
    write_roles(order.folder, roles)
    return made


def known_roles(folder: Path) -> dict[CertificateRole, tuple[str, ...]]:
    """The lab's list of roles, empty if there is none yet."""
    path = folder / ROLES
    if not path.exists():
        return {}
    try:
        return load_toml(path, RolesFile).roles.table()
    except ConfigError as error:
        raise LabError(str(error)) from error


def remove_party(folder: Path, name: str) -> CertificateRole:
    """Remove a name from the list of roles, in all folders; `LabError` if it is not on it.

    Machines that have their own copies need the new ``roles.toml``.
    """
    roles = known_roles(folder)
    role = next((r for r, names in roles.items() if name in names), None)
    if role is None:
        named = ", ".join(n for names in roles.values() for n in names) or "nobody"
        raise LabError(f"{name!r} is not in {folder / ROLES}; named there: {named}")
    roles[role] = tuple(n for n in roles[role] if n != name)
    write_roles(folder, roles)
    return role


def write_roles(folder: Path, roles: dict[CertificateRole, tuple[str, ...]]) -> None:
    """Write the list of roles to the lab's folder and to that of every party in it."""
    for place in (folder, *(folder / n for names in roles.values() for n in names)):
        if not place.is_dir():
            continue
        lines = ["# Certificate names that are let in, by role; every machine of the rig has this."]
        if place != folder:
            lines.append(f'name = "{place.name}"')
        lines += ["", "[roles]"]
        for role in CERTIFICATE_ROLES:
            names = ", ".join(f'"{name}"' for name in roles.get(role, ()))
            lines.append(f"{role} = [{names}]")
        _write(place / ROLES, ("\n".join(lines) + "\n").encode(), 0o644)


def _check(order: Order) -> None:
    if not order.parties:
        raise LabError("nobody to make keys for: name a party")
    seen: set[str] = set()
    for name, _ in order.parties:
        if not PARTY.fullmatch(name):
            raise LabError(f"{name!r} is not a name: letters, digits, . _ and -, at most 64")
        if name in seen:
            raise LabError(f"{name!r} is given twice")
        seen.add(name)
    for host in order.hosts:
        if not re.fullmatch(r"[A-Za-z0-9._:*-]{1,253}", host):
            raise LabError(f"{host!r} is not a host: give a name or an address")
    try:
        import cryptography  # noqa: F401 - only whether it is installed
    except ImportError as error:
        raise LabError(
            "making keys needs the package cryptography: pip install 'tactile-reach[keys]'"
        ) from error


@dataclass(frozen=True)
class _Authority:
    certificate: Certificate
    key: EllipticCurvePrivateKey


def _authority(order: Order) -> _Authority:
    """Load the lab's authority from its folder, or make a new one."""
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    certificate_file, key_file = order.folder / CA, order.folder / CA_KEY
    if certificate_file.exists() or key_file.exists():
        try:
            key = serialization.load_pem_private_key(key_file.read_bytes(), None)
            certificate = x509.load_pem_x509_certificate(certificate_file.read_bytes())
        except (OSError, ValueError) as error:
            raise LabError(
                f"{order.folder} holds an authority that cannot be used ({error}): put its {CA} "
                f"and {CA_KEY} back, or name another folder for a new one"
            ) from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise LabError(f"{key_file} is not a key of this program: name another folder")
        return _Authority(certificate, key)
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"tactile lab {os.urandom(4).hex()}")
    builder = _builder(order, name, name, key.public_key(), days=3650.0).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True
    )
    builder = builder.add_extension(_usage(authority=True), critical=True).add_extension(
        x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False
    )
    made = _Authority(_sign(builder, key), key)
    _write(key_file, _private(key), 0o600)
    _write(certificate_file, _pem(made.certificate), 0o644)
    return made


def _party(
    authority: _Authority, order: Order, folder: Path, name: str, role: CertificateRole
) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    key = ec.generate_private_key(ec.SECP256R1())
    issuer = authority.certificate.subject
    builder = _builder(order, _name(name), issuer, key.public_key(), days=order.days)
    builder = builder.add_extension(
        x509.BasicConstraints(ca=False, path_length=None), critical=True
    ).add_extension(_usage(authority=False), critical=True)
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role in SERVER_ROLES:
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = x509.SubjectAlternativeName(list(_hosts((*LOCAL_NAMES, *order.hosts))))
        builder = builder.add_extension(names, critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False).add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
        critical=False,
    )
    _write(folder / PRIVATE_KEY, _private(key), 0o600)
    _write(folder / CERTIFICATE, _pem(_sign(builder, authority.key)), 0o644)
    _write(folder / CA, _pem(authority.certificate), 0o644)


def _hosts(hosts: Iterable[str]) -> Iterable[Any]:
    from cryptography import x509

    for host in dict.fromkeys(hosts):
        with contextlib.suppress(ValueError):
            yield x509.IPAddress(ipaddress.ip_address(host))
            continue
        yield x509.DNSName(host)


def _name(text: str) -> Name:
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _builder(order: Order, subject: Name, issuer: Name, public: Any, days: float) -> Any:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(order.now - BACKDATED)
        .not_valid_after(order.now + datetime.timedelta(days=days))
    )


def _usage(*, authority: bool) -> Any:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _sign(builder: CertificateBuilder, key: EllipticCurvePrivateKey) -> Certificate:
    from cryptography.hazmat.primitives import hashes

    return builder.sign(key, hashes.SHA256())


def _pem(certificate: Certificate) -> bytes:
    from cryptography.hazmat.primitives import serialization

    return certificate.public_bytes(serialization.Encoding.PEM)


def _private(key: EllipticCurvePrivateKey) -> bytes:
    from cryptography.hazmat.primitives import serialization

    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _write(path: Path, data: bytes, mode: int) -> None:
    """Write in one step, with the file mode set from the first byte on."""
    new = path.with_name(f".{path.name}.{os.getpid()}")
    file = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, mode)
    try:
        os.fchmod(file, mode)
        with open(file, "wb") as stream:
            stream.write(data)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
