"""The command ``armd``."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from armd.drivers.catalogue import DRIVERS, make_driver
from tactile_core.cli import (
    DONE,
    REFUSED,
    CommandError,
    Parser,
    add_bus,
    positive,
    set_up_logging,
)
from tactile_core.daemon import Shutdown, exit_process, run, serve

log = logging.getLogger(__name__)

SWITCH_INTERVAL_S = 0.0005
"""Python's switch interval, s: threads that read, move and answer share the interpreter."""

EPILOG = (
    "Exit: 0 done (also on Ctrl-C, SIGTERM), 1 a thread failed, 2 usage or configuration, 3 the "
    "robot is not there or not ready. docs/arm.md says what each driver needs, and that none was "
    "tried on a real robot."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Serve a robot or teach it where the cupboard is; return the exit status.

    Without ``argv`` this is the whole process, which then ends here.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    code = run(teach_parser, words[1:]) if words[:1] == ["teach"] else run(serve_parser, words)
    if argv is None:
        exit_process(code)
    return code


def serve_parser(shutdown: Shutdown) -> argparse.ArgumentParser:
    """Parser of ``armd``."""
    parser = Parser(
        prog="armd",
        description="Serve a robot as an arm on the bus: arm/NAME/state, cmd_vel and services. "
        "`armd teach` touches three points, so that it knows where the cupboard is.",
        epilog=EPILOG,
    )
    _add_robot(parser)
    parser.add_argument(
        "--arm", default="arm", metavar="NAME", help="its name on the bus (default arm)"
    )
    add_bus(parser, "arm")
    parser.set_defaults(func=partial(_serve, shutdown))
    return parser


def teach_parser(_: Shutdown) -> argparse.ArgumentParser:
    """Parser of ``armd teach``."""
    parser = Parser(
        prog="armd teach",
        description="Ask for three touched points and write them into the configuration as "
        "[frame]. The tip is led there by hand or by the pendant; armd moves nothing.",
        epilog=EPILOG,
    )
    _add_robot(parser)
    parser.add_argument(
        "--reach", type=positive("m"), metavar="M",
        help="m from the pivot to the tip that touches (default: that of the finger, 0.158)",
    )  # fmt: skip
    parser.set_defaults(func=_teach)
    return parser


def _add_robot(parser: Parser) -> None:
    parser.show_version()
    parser.add_argument("--driver", required=True, choices=list(DRIVERS), help="kind of robot")
    parser.add_argument(
        "--config", type=Path, required=True, metavar="FILE",
        help="TOML file: address, tool and frame",
    )  # fmt: skip
    parser.add_argument("--verbose", "-v", action="store_true", help="say more")


def _teach(options: argparse.Namespace) -> int:
    from rich.console import Console

    from armd.config import load_config
    from armd.driver import DriverError, SetupError
    from armd.teach import TeachError, teach
    from tactile_core.config import ConfigError
    from tactile_core.geometry import TIP_X

    set_up_logging(Console(stderr=True), verbose=options.verbose)
    reach = TIP_X if options.reach is None else options.reach
    try:
        config = load_config(options.config)
        driver = make_driver(options.driver, config)
        driver.connect()
        try:
            teach(driver, config, options.config, reach, sys.stdin, sys.stdout)
        finally:
            driver.close()
    except (ConfigError, SetupError, TeachError) as error:
        raise CommandError(str(error)) from error
    except DriverError as error:
        raise CommandError(str(error), REFUSED) from error
    return DONE


def _serve(shutdown: Shutdown, options: argparse.Namespace) -> int:
    from rich.console import Console

    from armd.config import load_config, plane_of
    from armd.daemon import Daemon
    from armd.driver import DriverError, SetupError
    from tactile_core.bus.topics import NAME
    from tactile_core.config import ConfigError
    from tactile_core.options import bus_config

    set_up_logging(Console(stderr=True), verbose=options.verbose)
    if not NAME.fullmatch(options.arm):
        raise CommandError(
            f"--arm {options.arm!r} cannot be a name; allowed: letters, digits, _ and -, at most 64"
        )
    try:
        config = load_config(options.config)
        plane = plane_of(config, str(options.config))
        driver = make_driver(options.driver, config)
    except (ConfigError, SetupError) as error:
        raise CommandError(str(error)) from error
    except DriverError as error:
        raise CommandError(str(error), REFUSED) from error
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    bus = bus_config(options, config.bus, "arm")
    daemon = Daemon(driver, config, plane, bus, options.arm)

    def work() -> int:
        print(f"arm {options.arm}: {options.driver}, ready for reachd", flush=True)
        daemon.watch(shutdown.requested.is_set)
        return DONE

    return serve(daemon, shutdown, f"{options.driver} as arm {options.arm}", work)


if __name__ == "__main__":
    sys.exit(main())
