"""``tactile bus``: make keys for a lab, show the secret of this user's rigs."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_core.cli import REFUSED, CommandError
from tactile_tools.operate.lab_keys import DEFAULT_PARTIES, LabError, Order, make_keys, remove_party


def keys(options: argparse.Namespace) -> int:
    """``tactile bus keys``."""
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
        raise CommandError(str(error)) from error
    except OSError as error:
        raise CommandError(f"{error.filename}: {error.strerror}", REFUSED) from error
    for path in made:
        print(f"made {path}")
    print(f"Give each command the folder of its party: --keys {made[0]}")
    print(f"Keep {folder / 'ca.key'} off the robots: whoever has it can make keys.")
    return 0


def secret(options: argparse.Namespace) -> int:
    """``tactile bus secret``."""
    from tactile_core.bus.runtime import USER, RuntimeFolderError, find_runtime, home, token_file

    try:
        path, secret = token_file(home())
    except RuntimeFolderError as error:
        raise CommandError(str(error), REFUSED) from error
    print(f"sockets: {find_runtime().bus}")
    print(f"secret:  {path}")
    if options.show:
        print(f"user:    {USER}")
        print(f"password: {secret}")
    return 0
