"""``tactile completion``: a script that lets a shell complete our commands."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_core.cli import DONE, load_all, require


def parsers() -> list[argparse.ArgumentParser]:
    """Parsers of all five commands, with every subcommand loaded."""
    from armd.cli import serve_parser as armd
    from reachd.arguments import make_parser as reachd
    from sim_device.arguments import make_parser as simdevice
    from tactile_core.daemon import Shutdown
    from tactile_tools.cli import make_parser as tactile
    from tactiled.arguments import make_parser as tactiled

    roots = [tactile(), tactiled(), reachd(), armd(Shutdown()), simdevice()]
    for root in roots:
        load_all(root)
    return roots


def script(shell: str) -> str:
    """The script for ``shell``: bash, zsh or fish; `MissingExtraError` without the extra."""
    require("shtab", extra="completion")
    import shtab

    texts = []
    for root in parsers():
        for parser in load_all(root):
            for action in parser._actions:
                if action.type is Path:
                    action.complete = shtab.FILE  # type: ignore[attr-defined]  # shtab reads it
                if isinstance(action, argparse._SubParsersAction):
                    # A shell shows a line beside each command; descriptions are paragraphs.
                    for choice in action._choices_actions:
                        action.choices[choice.dest].description = choice.help
        texts.append(shtab.complete(root, shell=shell))
    return "\n".join(texts)


def run(options: argparse.Namespace) -> int:
    """Print the script."""
    print(script(options.shell))
    return DONE
