"""``tactile ros2``: the bridge as a command, and the message package."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from tactile_core.bus.topics import NAME
from tactile_core.cli import Command, Parser, add_bus, add_commands, add_path
from tactile_tools.ros2.names import DEFAULT_DISTRO, DISTROS, MAX_DOMAIN, NAMESPACE, NODE_NAME

DONE, REFUSED = 0, 3


HERE = "tactile_tools.ros2.cli"

COMMANDS = {
    "bridge": Command(
        "make our streams ROS 2 topics, and pass requests on", f"{HERE}:_fill_bridge"
    ),
    "package": Command("write the ROS 2 source package tactile_msgs", f"{HERE}:_fill_package"),
}


def fill(parser: Parser) -> None:
    """Add the subcommands of ``tactile ros2``."""
    parser.description = "ROS 2 without ROS installed here: docs/ros2.md."
    add_commands(parser, COMMANDS)


def _fill_bridge(bridge: Parser) -> None:
    bridge.description = (
        "Runs until it is stopped. Connects to a ROS 2 router (rmw_zenohd) as a client and to the "
        "bus of this rig as a tool. Requests from ROS are refused unless accepted by name, because "
        "anyone who reaches the router may send them."
    )
    bridge.epilog = "exit status: 0 stopped; 2 bad argument; 3 no router."
    bridge.add_argument(
        "--router",
        default="tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
        help="zenoh endpoint of the ROS 2 router (default %(default)s)",
    )
    bridge.add_argument(
        "--domain",
        type=_domain,
        default=os.environ.get("ROS_DOMAIN_ID", "0"),
        metavar="N",
        help="ROS domain id (default: ROS_DOMAIN_ID, or 0)",
    )
    bridge.add_argument(
        "--distro",
        choices=DISTROS,
        default=_default_distro(),
        help="ROS 2 distribution of the other side (default: ROS_DISTRO, or jazzy)",
    )
    bridge.add_argument(
        "--namespace",
        type=_namespace,
        default="",
        metavar="/NS",
        help="ROS namespace that topics are put into",
    )
    bridge.add_argument(
        "--node-name",
        dest="node",
        type=_node,
        default="tactile_bridge",
        metavar="NAME",
        help="name of the ROS node",
    )
    bridge.add_argument(
        "--accept",
        action="append",
        choices=("goals", "twist", "wrench"),
        default=[],
        help="pass on from ROS: goals to reachd; twists for the strategy FollowTwist; wrenches as "
        "a board's reference while it is calibrated; may be repeated",
    )
    bridge.add_argument(
        "--reach",
        type=_name,
        default="reach",
        metavar="NAME",
        help="reachd that goals and twists are for (default %(default)s)",
    )
    bridge.add_argument("--verbose", "-v", action="store_true", help="say more")
    add_bus(bridge, "tool")
    bridge.set_defaults(func=_bridge)


def _fill_package(package: Parser) -> None:
    package.description = (
        "Writes package.xml, CMakeLists.txt and the message definitions: put the folder into a "
        "workspace's src and build it with colcon."
    )
    add_path(package, "--out", "folder to write (default: ./tactile_msgs)")
    package.set_defaults(func=_package)


def _default_distro() -> str:
    named = os.environ.get("ROS_DISTRO", "")
    return named if named in DISTROS else DEFAULT_DISTRO


def _domain(text: str) -> int:
    if text.isdecimal() and int(text) <= MAX_DOMAIN:
        return int(text)
    raise argparse.ArgumentTypeError(f"invalid domain {text!r}; expected 0 to {MAX_DOMAIN}")


def _namespace(text: str) -> str:
    text = text.rstrip("/")
    if text and not text.startswith("/"):
        text = "/" + text
    if NAMESPACE.fullmatch(text):
        return text
    raise argparse.ArgumentTypeError(
        f"invalid namespace {text!r}; expected /NAME with letters, digits and _ (no digit in front)"
    )


def _node(text: str) -> str:
    if NODE_NAME.fullmatch(text):
        return text
    raise argparse.ArgumentTypeError(
        f"invalid node name {text!r}; expected letters, digits and _ (no digit in front)"
    )


def _name(text: str) -> str:
    if NAME.fullmatch(text):
        return text
    raise argparse.ArgumentTypeError(f"invalid name {text!r}; expected letters, digits, _ and -")


def _package(options: argparse.Namespace) -> int:
    from tactile_tools.ros2.package import PACKAGE, write

    options.out = options.out or Path(PACKAGE)
    try:
        written = write(options.out)
    except OSError as error:
        print(
            f"tactile ros2 package: cannot write {error.filename}: {error.strerror}; name another "
            "folder with --out",
            file=sys.stderr,
        )
        return REFUSED
    print(f"wrote {options.out} ({len(written)} files): build it with colcon in a ROS 2 workspace")
    return DONE


def _bridge(options: argparse.Namespace) -> int:
    from tactile_tools.ros2.run import run

    return run(options)
