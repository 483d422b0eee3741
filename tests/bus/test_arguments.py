"""Values with a leading minus are values, in every command."""

from __future__ import annotations

import argparse
from collections import defaultdict

import pytest
from tactile_core.arguments import Parser

from reachd.arguments import make_parser as reachd
from reachd.cli import main
from sim_device.arguments import make_parser as simdevice
from tactile_tools.cli import build_parser as tactile
from tactiled.arguments import make_parser as tactiled

VALUES = ("-0.25,0.1,0", "-.5,1", "-30deg/10s", "-5", "-1e-3", "-inf", "-NaN", "-0.1")


def parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """A parser and those of its subcommands."""
    found = [parser]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                found += parsers(each)
    return found


EVERY = [
    each
    for parser in (tactiled(), reachd(), simdevice(defaultdict(lambda: id)), tactile())
    for each in parsers(parser)
]


@pytest.mark.parametrize("parser", EVERY, ids=lambda parser: parser.prog)
def test_no_parser_takes_a_negative_value_for_a_flag(parser: argparse.ArgumentParser) -> None:
    assert isinstance(parser, Parser)
    flags = [flag for action in parser._actions for flag in action.option_strings]
    for value in VALUES:
        assert parser._parse_optional(value) is None, value
    for flag in flags:
        assert parser._parse_optional(flag) is not None, flag


def test_a_home_behind_the_cupboards_edge_is_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    options = reachd().parse_args(["--home", "-0.25,0.1,0", "--target", "-0.1,0.2"])
    assert (options.home, options.target) == ("-0.25,0.1,0", "-0.1,0.2")
    with pytest.raises(SystemExit) as caught:
        main(["--home", "--target", "0.1,0"])
    assert caught.value.code == 2
    assert "--home: expected one argument" in capsys.readouterr().err
