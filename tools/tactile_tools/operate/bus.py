"""``tactile bus``: keys for a lab, the secret of this user's rigs, who is connected."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tactile_core.bus.rights import CERTIFICATE_ROLES
from tactile_tools.operate.lab_keys import DEFAULT_PARTIES, LabError, Order, make_keys, remove_party

MAX_DAYS = 3650.0


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bus`` to the umbrella command."""
    parser = subparsers.add_parser(
        "bus",
        help="make keys for a lab, show the secret of this user's rigs",
        description="Who may join the bus: keys for rigs over TLS, the secret of rigs on one "
        "machine. What protects what: docs/security.md.",
    )
    tools = parser.add_subparsers(dest="bus_tool", metavar="TOOL", required=True)
    keys = tools.add_parser(
        "keys",
        help="make a certificate authority and a folder of keys for each party",
        description="Makes FOLDER/NAME for each party, with its certificate, its private key, the "
        "authority's certificate and the list of roles: copy it to the party's machine and give it "
        "to every command as --keys. FOLDER/ca.key makes more keys: keep it off the robots. Called "
        "again, it adds parties; then every machine needs the new roles.toml.",
    )
    keys.add_argument("folder", type=Path, metavar="FOLDER", help="the lab's folder of keys")
    keys.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="HOST",
        help="name or address at which daemons are reached from other machines; may be repeated",
    )
    keys.add_argument(
        "--party",
        action="append",
        type=_party,
        metavar="NAME=ROLE",
        help=f"party to make keys for; roles: {', '.join(CERTIFICATE_ROLES)} (default: one of each "
        "role, called like it); may be repeated",
    )
    keys.add_argument(
        "--days",
        type=_days,
        default=825.0,
        metavar="D",
        help="how long the certificates hold (days; default %(default)g)",
    )
    keys.add_argument("--again", action="store_true", help="new keys for parties that have some")
    keys.add_argument("--remove", metavar="NAME", help="take a party off the list of roles instead")
    keys.set_defaults(func=_keys)
    secret = tools.add_parser(
        "secret",
        help="show where this user's processes meet, and what other programs join with",
        description="Shows the folder of the sockets and the file of the secret; with --show the "
        "user and password that a zenoh program of another kind joins with "
        "(transport/auth/usrpwd).",
    )
    secret.add_argument("--show", action="store_true", help="print the secret itself")
    secret.set_defaults(func=_secret)


def _party(text: str) -> tuple[str, str]:
    name, equals, role = text.partition("=")
    if not equals or role not in CERTIFICATE_ROLES:
        raise argparse.ArgumentTypeError(
            f"{text} given; allowed: NAME=ROLE with a role of {', '.join(CERTIFICATE_ROLES)}"
        )
    return name, role


def _days(text: str) -> float:
    try:
        days = float(text)
    except ValueError:
        days = 0.0
    if not 0 < days <= MAX_DAYS:
        raise argparse.ArgumentTypeError(f"{text} given; allowed: above 0, at most {MAX_DAYS:g}")
    return days


def _keys(options: argparse.Namespace) -> int:
    folder: Path = options.folder
    try:
        if options.remove is not None:
            role = remove_party(folder, options.remove)
            print(
                f"{options.remove} has lost the role {role}; copy the new roles.toml of each "
                f"party's folder in {folder} to its machine and restart what runs there"
            )
            return 0
        made = make_keys(
            Order(
                folder,
                options.party or DEFAULT_PARTIES,
                tuple(options.host),
                options.days,
                options.again,
            )
        )
    except LabError as error:
        print(f"tactile bus keys: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"tactile bus keys: {error.filename}: {error.strerror}", file=sys.stderr)
        return 3
    for path in made:
        print(f"made {path}")
    print(f"Give each command the folder of its party: --keys {made[0]}")
    print(f"Keep {folder / 'ca.key'} off the robots: whoever has it can make keys.")
    return 0


def _secret(options: argparse.Namespace) -> int:
    from tactile_core.bus.runtime import USER, RuntimeFolderError, find_runtime, home, token_file

    try:
        path, secret = token_file(home())
    except RuntimeFolderError as error:
        print(f"tactile bus secret: {error}", file=sys.stderr)
        return 3
    print(f"sockets: {find_runtime().bus}")
    print(f"secret:  {path}")
    if options.show:
        print(f"user:    {USER}")
        print(f"password: {secret}")
    return 0
