"""Command line of ``tactile``: one subcommand per tool, loaded when it is used."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Final

from sim_device.world.engines import ENGINES
from tactile_core.cli import (
    Command,
    Parser,
    add_board,
    add_bus,
    add_commands,
    add_json,
    add_out,
    add_path,
    add_seeds,
    add_strategies,
    checked,
    count,
    hertz,
    later,
    natural,
    number,
    positive,
    run_command,
    seconds,
    seed,
    whole,
)
from tactile_tools.options import (
    add_depth,
    add_engine,
    add_jobs,
    add_log_files,
    add_report,
    add_scene,
    add_strategy,
)

HERE: Final = "tactile_tools.cli"
BUS: Final = "tactile_tools.bus_commands"

COMMANDS: Final = {
    "log": Command(
        "inspect, repair, convert, replay and reprocess MCAP logs", "tactile_tools.log.cli"
    ),
    "plot": Command(
        "draw a reach, taxel maps, forces, field or timing of a log",
        f"{HERE}:_fill_plot",
    ),
    "status": Command("how the boards of a running tactiled do", f"{HERE}:_fill_status"),
    "tare": Command("take what the untouched skin reads now as its rest", f"{HERE}:_fill_tare"),
    "health": Command("say in one line whether a rig is well", f"{HERE}:_fill_health"),
    "view": Command("the live page: skin, forces and reach in a browser", f"{BUS}:fill_view"),
    "list": Command("what is on the bus: keys, rates, services", f"{BUS}:fill_list"),
    "echo": Command("print the messages of a key", f"{BUS}:fill_echo"),
    "hz": Command("rate, jitter and losses of a key", f"{BUS}:fill_hz"),
    "call": Command("ask a service of a daemon", f"{BUS}:fill_call"),
    "cpp-header": Command("messages and their decoder as a C++ header", f"{BUS}:fill_cpp_header"),
    "board-check": Command(
        "prove that a board speaks the wire protocol", f"{HERE}:_fill_board_check"
    ),
    "calibrate": Command(
        "fit models of force to recordings of a board, and judge them",
        "tactile_tools.calibrate.cli",
    ),
    "reach": Command("run one reach in lockstep, faster than real time", f"{HERE}:_fill_reach"),
    "experiment": Command(
        "repeat the paper's studies: trials, statistics, report",
        "tactile_tools.experiments.cli",
    ),
    "benchmark": Command(
        "judge a strategy on fixed scene sets, for the leaderboard",
        "tactile_tools.experiments.cli:fill_benchmark",
    ),
    "demo": Command(
        "reach into a simulated cupboard, leave a log and a picture",
        f"{HERE}:_fill_demo",
    ),
    "demo-skin": Command(
        "press simulated boards, leave a log and a picture",
        f"{HERE}:_fill_demo_skin",
    ),
    "train": Command(
        "train the strategy `learned` in the planar engine", "tactile_tools.train.cli"
    ),
    "bus": Command("make keys for a lab, show the secret of this user's rigs", f"{HERE}:_fill_bus"),
    "service": Command(
        "install the daemons as systemd services, or remove them",
        f"{HERE}:_fill_service",
    ),
    "foxglove": Command("show the running rig live in Foxglove", f"{HERE}:_fill_foxglove"),
    "ros2": Command("bridge to ROS 2, and the message package", "tactile_tools.ros2.cli"),
    "completion": Command(
        "print a script that lets a shell complete our commands", f"{HERE}:_fill_completion"
    ),
    "bench": Command("measure every promised figure", f"{HERE}:_fill_bench"),
    "fidelity": Command(
        "compare our engine with the authors' recorded outcomes",
        f"{HERE}:_fill_fidelity",
    ),
    "crosscheck": Command(
        "compare an engine with another, trial by trial",
        f"{HERE}:_fill_crosscheck",
    ),
    "fuzz": Command("corrupt frames and check that none is accepted wrongly", f"{HERE}:_fill_fuzz"),
    "crash": Command(
        "kill processes that log, and check what they leave",
        f"{HERE}:_fill_crash",
    ),
    "mutation": Command(
        "mutate the safety gate and report what its tests miss", f"{HERE}:_fill_mutation"
    ),
    "soak": Command(
        "replug boards for an hour, and watch memory and descriptors",
        f"{HERE}:_fill_soak",
    ),
    "arm-scenes": Command(
        "compare arms, emulated robots too, on the same scenes",
        f"{HERE}:_fill_arm_scenes",
    ),
}

WHATS = ("reach", "taxels", "forces", "field", "timing")
"""What `plot` can draw."""

ROLES = ("tactiled", "reachd", "arm", "operator", "viewer")
"""Roles of a certificate, the same as `tactile_core.bus.rights.CERTIFICATE_ROLES`."""

GATE_FILES = ("gate/gate.py", "gate/limits.py", "gate/motion.py")
"""Files of ``reachd`` that `mutation` changes."""

MAX_DAYS = 3650.0
"""Longest validity of a certificate, days."""

ARMS = ("simulated", "ur", "xarm")
"""What can move the finger in a demo, as `tactile_tools.reach.one_reach.ARMS`."""

SOAKED = 16
"""Greatest number of boards in a `soak`."""


def make_parser() -> Parser:
    """Parser of ``tactile``; the parsers of its subcommands are filled when they are used."""
    parser = Parser(
        prog="tactile",
        description="Ask and tare boards, inspect, recover and plot logs, run reaches, demos, "
        "benchmarks and fuzzers, look after a rig.",
    )
    parser.show_version()
    add_commands(parser, COMMANDS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one tool. Returns its exit status: 0 only when the job was done, 2 for a bad argument."""
    # Our matrices are small: threads of the linear algebra library gain nothing on them, and on a
    # machine busy with trials they wait for one another far longer than they work. numpy reads this
    # variable when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return run_command(make_parser(), argv)


def _fill_plot(parser: Parser) -> None:
    parser.description = (
        "Draw a log. reach: the cupboard from above and what happened; taxels: maps of "
        "each side at the strongest moments (circles: normal force, arrows: shear); forces: "
        "features and events over time; field: what compensation removed; timing: clock and "
        "latency. No display is needed."
    )
    parser.former(name="board", size="width")
    add_log_files(parser)
    add_path(parser, "--out", "picture (default: FILE with .png, or with --format)")
    parser.add_argument(
        "--what",
        choices=WHATS,
        help="default: the reach if the log holds one, else an overview of the skin",
    )
    add_board(parser, "to draw (default: the one with the most taxels)")
    parser.add_argument(
        "--reach",
        type=whole(least=1),
        metavar="N",
        help="which of several reaches to draw, in the order they began (default: the last)",
    )
    parser.add_argument(
        "--arm", metavar="NAME", help="arm of the reach (default: the one heard most)"
    )
    parser.add_argument(
        "--width",
        choices=("screen", "page", "column"),
        default="screen",
        help="for a screen (default), a paper's page (180 mm) or its column (89 mm)",
    )
    parser.add_argument("--format", choices=("png", "pdf", "svg"), help="default: by --out, or png")
    parser.add_argument(
        "--dpi",
        type=natural,
        metavar="N",
        help="dots an inch, 30 to 600 (default: 100 for a screen, 300 for a paper)",
    )
    parser.add_argument(
        "--at",
        type=number("s"),
        action="append",
        metavar="TIME",
        help="moment of the taxel maps, s since the first cycle (default: the strongest); may be "
        "repeated",
    )
    parser.set_defaults(func=later("tactile_tools.plot.cli:run"))


def _add_asked_board(parser: Parser, what: str) -> None:
    parser.add_argument(
        "board", nargs="?", metavar="BOARD", help=f"name of the board {what}, as tactiled has it"
    )
    add_bus(parser, "tool")


def _fill_status(parser: Parser) -> None:
    parser.description = (
        "Says of each board what it feels, whether that can be relied on and if not "
        "why, its rest, rate, clock, losses, taxels, calibration and log."
    )
    parser.epilog = "exit status: 0 told; 2 no such board; 3 no tactiled."
    _add_asked_board(parser, "(default: all)")
    add_json(parser, "print everything tactiled knows as JSON, an object by board")
    parser.set_defaults(func=later("tactile_tools.operate.status:run"))


def _fill_tare(parser: Parser) -> None:
    parser.description = (
        "Tares a board of a running tactiled. Lift the skin off everything and keep it "
        "still. A tare that is refused changes nothing and says what to do."
    )
    parser.epilog = "exit status: 0 tared; 2 no such board; 3 no tactiled, or refused."
    _add_asked_board(parser, "to tare (may be left out where there is only one)")
    parser.add_argument(
        "--force",
        action="store_true",
        help="tare whatever speaks against it: what is on the skin now will read as no force",
    )
    parser.set_defaults(func=later("tactile_tools.operate.tare:run"))


def _fill_health(parser: Parser) -> None:
    parser.description = (
        "Asks every board, reach and arm on the bus how it is. Exit: 0 all well; 1 to "
        "be looked at (an alarm, features not valid, a late loop); 2 bad argument; 3 nobody "
        "answers, or the bus cannot be joined; 4 failed (a board silent or refused, a log that is "
        "not written, one that was named and is not there)."
    )
    parser.former(timeout="wait")
    for kind in ("board", "reach", "arm"):
        parser.add_argument(
            f"--{kind}",
            action="append",
            default=[],
            metavar="NAME",
            help=f"{kind} that must be there; may be repeated (default: those that are)",
        )
    parser.add_argument(
        "--wait",
        type=seconds,
        default=2.0,
        metavar="S",
        help="how long to wait for answers (s; default %(default)g)",
    )
    add_json(parser, "print all of it as JSON")
    add_bus(parser, "tool")
    parser.set_defaults(func=later("tactile_tools.operate.health:run"))


def _fill_reach(parser: Parser) -> None:
    parser.description = (
        "World, arm, touch, strategy and safety gate in one process on virtual time: "
        "the daemons' own objects. The same scene, strategy and seed give the same trial. "
        "Exit: 0 reached, 1 not reached, 2 bad argument, 3 refused by the system."
    )
    add_strategy(parser)
    add_seeds(parser)
    # Former option: --seed used to choose the scene, too.
    parser.add_argument("--trial-seed", type=seed, help=argparse.SUPPRESS)
    add_scene(parser)
    parser.add_argument("--set", metavar="SET", help="parameter set (default: that of the scene)")
    add_depth(parser)
    add_engine(parser)
    add_path(parser, "--log", "MCAP file of the trial")
    add_path(parser, "--png", "picture of the trial; needs --log")
    parser.add_argument(
        "--headless", action="store_true", help="accepted for clarity: there is no window"
    )
    parser.set_defaults(func=later("tactile_tools.reach.cli:run"))


def _fill_demo(parser: Parser) -> None:
    parser.description = (
        "Starts a simulated cupboard with arm and finger, tactiled on the finger's "
        "board, and reachd; prints the outcome, leaves a log and a picture of the reach. "
        "Exit: 0 reached, 1 not reached, 2 bad argument, 3 refused by the system."
    )
    parser.former(out="log")
    _add_demo_files(parser, "demo")
    add_strategy(parser)
    add_scene(parser)
    add_seeds(parser, default=35)
    parser.add_argument(
        "--arm",
        choices=ARMS,
        default="simulated",
        help="what moves the finger: the simulated arm, or an emulated robot of Universal Robots "
        "or UFACTORY through armd and its vendor's client (default simulated)",
    )
    parser.add_argument(
        "--view-port",
        type=whole(most=65_535),
        default=8420,
        metavar="N",
        help="of the live page on which the demo can be watched (default 8420; another that is "
        "free when that is in use)",
    )
    parser.add_argument("--no-view", action="store_true", help="open no page")
    parser.set_defaults(func=later("tactile_tools.demo:run"))


def _fill_demo_skin(parser: Parser) -> None:
    parser.description = (
        "Starts a simulated finger (serial) and a simulated AnySkin board, runs "
        "tactiled on both, presses and turns the finger, and leaves a log and a picture."
    )
    parser.former(out="log")
    _add_demo_files(parser, "demo-skin")
    parser.add_argument(
        "--duration",
        type=number("s", above=0, most=600),
        default=24.0,
        metavar="S",
        help="how long, s (default 24)",
    )
    parser.set_defaults(func=later("tactile_tools.demo_skin:run"))


def _add_demo_files(parser: Parser, stem: str) -> None:
    default = f"default {stem}.mcap and {stem}.png, or with the next free number: {stem}-2.mcap"
    add_path(parser, "--log", f"log to leave ({default})")
    add_path(parser, "--png", "picture to leave (default: beside the log, with .png)")
    parser.add_argument("--force", action="store_true", help="overwrite what is there")


def _fill_bus(parser: Parser) -> None:
    parser.description = (
        "Who may join the bus: keys for rigs over TLS, the secret of rigs on one "
        "machine. What protects what: docs/security.md."
    )
    add_commands(
        parser,
        {
            "keys": Command(
                "make an authority and a folder of keys for each party",
                f"{HERE}:_fill_keys",
            ),
            "secret": Command(
                "show where this user's processes meet, and their secret",
                f"{HERE}:_fill_secret",
            ),
        },
    )


def _fill_keys(parser: Parser) -> None:
    from pathlib import Path

    parser.description = (
        "Makes FOLDER/NAME for each party, with its certificate, its private key, the "
        "authority's certificate and the list of roles: copy it to the party's machine and give it "
        "to every command as --keys. FOLDER/ca.key makes more keys: keep it off the robots. Called "
        "again, it adds parties; then every machine needs the new roles.toml."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the lab's folder of keys")
    parser.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="HOST",
        help="name or address at which daemons are reached from other machines; may be repeated",
    )
    parser.add_argument(
        "--party",
        action="append",
        type=checked(_party),
        metavar="NAME=ROLE",
        help=f"party to make keys for; roles: {', '.join(ROLES)} (default: one of each "
        "role, called like it); may be repeated",
    )
    parser.add_argument(
        "--days",
        type=number("days", above=0, most=MAX_DAYS),
        default=825.0,
        metavar="D",
        help="how long the certificates hold (days; default %(default)g)",
    )
    parser.add_argument("--again", action="store_true", help="new keys for parties that have some")
    parser.add_argument(
        "--remove", metavar="NAME", help="take a party off the list of roles instead"
    )
    parser.set_defaults(func=later("tactile_tools.operate.bus:keys"))


def _party(text: str) -> tuple[str, str]:
    name, equals, role = text.partition("=")
    if not equals or role not in ROLES:
        raise ValueError(f"{text} given; allowed: NAME=ROLE with a role of {', '.join(ROLES)}")
    return name, role


def _fill_secret(parser: Parser) -> None:
    parser.description = (
        "Shows the folder of the sockets and the file of the secret; with --show the "
        "user and password that a zenoh program of another kind joins with "
        "(transport/auth/usrpwd)."
    )
    parser.add_argument("--show", action="store_true", help="print the secret itself")
    parser.set_defaults(func=later("tactile_tools.operate.bus:secret"))


def _fill_service(parser: Parser) -> None:
    parser.description = (
        "Installs units, udev rules, a user and first configurations, or takes them "
        "away; how to run them: docs/operations.md. Needs root, unless --root or --dry-run is "
        "given."
    )
    add_commands(
        parser,
        {
            "install": Command(
                "put the files in place; nothing is started", f"{HERE}:_fill_install"
            ),
            "uninstall": Command(
                "stop the services and delete the files", f"{HERE}:_fill_uninstall"
            ),
        },
    )


def _add_root(parser: Parser, what: str) -> None:
    from pathlib import Path

    add_path(
        parser,
        "--root",
        "folder to take for the root of the system (default /)",
        default=Path("/"),
    )
    parser.add_argument(
        "--dry-run", action="store_true", help=f"say what would be {what}, and do nothing"
    )


def _fill_install(parser: Parser) -> None:
    _add_root(parser, "written")
    add_path(parser, "--bin", "folder of tactiled and reachd (default: where this command is)")
    parser.set_defaults(func=later("tactile_tools.operate.service:install"))


def _fill_uninstall(parser: Parser) -> None:
    _add_root(parser, "deleted")
    parser.add_argument(
        "--purge", action="store_true", help="delete configurations in /etc/tactile as well"
    )
    parser.set_defaults(func=later("tactile_tools.operate.service:uninstall"))


def _fill_board_check(parser: Parser) -> None:
    parser.description = (
        "Holds a board on a serial port or a CAN bus to PROTOCOL.md: messages, refusals, rates, "
        "clock, counters, restart. It reboots the board, changes its rate and gain, and leaves it "
        "stopped, as after a reset. No tactiled may have the port."
    )
    parser.epilog = (
        "exit status: 0 all passed; 1 some failed; 2 bad argument; 3 no board, or port missing, "
        "busy or not permitted."
    )
    port = parser.add_mutually_exclusive_group(required=True)
    port.add_argument("--port", metavar="P", help="serial port, or usb:SERIAL_NUMBER")
    port.add_argument(
        "--can", metavar="SPEC", help="CAN bus INTERFACE:CHANNEL[@BITRATE[/DATA_BITRATE]][+fd]"
    )
    parser.add_argument(
        "--baud", type=count, default=115_200, metavar="BIT/S", help="of a UART (default 115200)"
    )
    parser.add_argument(
        "--node",
        type=whole(most=126),
        metavar="ID",
        help="number of the board on the bus, 0 to 126 (default: the only one that answers)",
    )
    parser.set_defaults(func=later("tactile_tools.board_check:run"))


def _fill_foxglove(parser: Parser) -> None:
    parser.description = (
        "Serves the streams of the bus to Foxglove until it is stopped, on this machine only: the "
        "protocol has no authentication (docs/foxglove.md)."
    )
    parser.epilog = "exit status: 0 stopped; 2 bad argument or foxglove-sdk missing; 3 port in use."
    parser.add_argument(
        "--port",
        type=whole(most=65_535),
        default=8765,
        metavar="N",
        help="TCP port, 0: any (default 8765)",
    )
    parser.add_argument(
        "--control",
        action="store_true",
        help="let viewers arm reachd, give it goals and set rates; every user of this machine may "
        "connect",
    )
    add_bus(parser, "tool")
    parser.set_defaults(func=later("tactile_tools.foxglove:run"))


def _fill_completion(parser: Parser) -> None:
    parser.description = (
        "Prints a script for your shell that completes tactile, tactiled, reachd, armd and "
        "simdevice. bash: tactile completion bash >> ~/.bash_completion; zsh: put the output into "
        "a file that ~/.zshrc sources after compinit; fish: tactile completion fish > "
        "~/.config/fish/conf.d/tactile.fish."
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="which shell")
    parser.set_defaults(func=later("tactile_tools.completion:run"))


def _fill_bench(parser: Parser) -> None:
    parser.description = (
        "Measures every promised figure in one run. What is compared is measured side by side, "
        "because machines are shared and noisy. Without --only every group that does not have to "
        "be named is measured; a wrong name lists the groups and figures there are."
    )
    add_report(parser)
    parser.add_argument(
        "--only",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="measure these groups only, or the groups of these figures; figures of other groups "
        "that are in --out are kept",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="shorter runs (some minutes in all); rougher figures",
    )
    parser.set_defaults(func=later("tactile_tools.dev.bench:run"))


def _fill_fidelity(parser: Parser) -> None:
    parser.description = (
        "Runs every strategy on recorded scenes and compares outcomes trial by trial "
        "with the reference, beside the agreement of our own repeated runs with starts moved by "
        "0.1 mm: the ceiling that chance allows."
    )
    parser.former(scenes="recorded", most="limit")
    add_path(
        parser,
        "--recorded",
        "recorded scenes (default: the authors', in the folder that TACTILE_SCENES_DIR names)",
    )
    add_path(
        parser,
        "--outcomes",
        "what the reference did there (default: beside the scenes, outcomes_1_60.csv of "
        "scenes_1_60.json.gz)",
    )
    add_engine(parser)
    add_depth(parser)
    parser.add_argument(
        "--repeats",
        type=natural,
        default=2,
        metavar="N",
        help="perturbed runs (default 2; 0: no ceiling)",
    )
    parser.add_argument("--limit", type=count, metavar="N", help="scenes to use (default: all)")
    add_jobs(parser)
    add_report(parser)
    parser.set_defaults(func=later("tactile_tools.dev.fidelity:run"))


def _fill_crosscheck(parser: Parser) -> None:
    parser.description = (
        "Runs strategies in the same scenes in two engines, and in the second once more with the "
        "start moved by 0.1 mm: how often outcomes agree, beside how often chance lets them. "
        "Ctrl-C ends it with what has been run."
    )
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        default="planar",
        help="engine to judge (default %(default)s)",
    )
    parser.add_argument(
        "--beside",
        choices=ENGINES,
        default=ENGINES[0],
        help="engine to judge it by (default %(default)s)",
    )
    parser.add_argument(
        "--scene",
        default="authors_sim",
        metavar="SCENE",
        help="a set of scenes by name, as for `tactile reach` (default %(default)s)",
    )
    parser.add_argument(
        "--scenes", type=count, default=100, metavar="N", help="how many (default %(default)s)"
    )
    parser.add_argument(
        "--from-seed",
        type=natural,
        default=1,
        metavar="N",
        help="seed of the first, the others follow (default %(default)s)",
    )
    add_strategies(parser, "strategies to run (default: all five)")
    add_depth(parser)
    add_jobs(parser)
    add_report(parser)
    parser.set_defaults(func=later("tactile_tools.dev.crosscheck:run"))


def _fill_fuzz(parser: Parser) -> None:
    parser.description = (
        "Corrupts serial frames and CAN transfers in every way and checks that every "
        "message that the decoders accept is one that was sent. Exit: 1 if one was not."
    )
    parser.former(seconds="duration")
    parser.add_argument(
        "--frames",
        type=count,
        default=1_000_000,
        metavar="N",
        help="frames to corrupt (default %(default)s)",
    )
    add_seeds(parser, default=1, what="of all random choices", scene=False)
    parser.add_argument(
        "--through",
        choices=("decoder", "pipeline"),
        default="decoder",
        help="decoder: corrupted frames (default); pipeline: frames with right CRCs that say "
        "anything",
    )
    parser.add_argument(
        "--from-block",
        type=natural,
        default=0,
        metavar="N",
        help="of the pipeline: go on from, or repeat, this block (default 0)",
    )
    _add_budget(parser, "of the pipeline: begin no block after so many seconds")
    add_jobs(parser)
    add_report(parser)
    parser.set_defaults(func=later("tactile_tools.dev.fuzz:run"))


def _add_budget(parser: Parser, what: str) -> None:
    import math

    parser.add_argument("--duration", type=seconds, default=math.inf, metavar="S", help=what)


def _fill_crash(parser: Parser) -> None:
    parser.description = (
        "Start processes that log, kill -9 each at a random moment, and check that "
        "every file they leave reads and recovers with at most 1 s lost."
    )
    parser.former(seconds="duration")
    parser.add_argument(
        "--kills", type=count, default=1000, metavar="N", help="kills in all (default 1000)"
    )
    parser.add_argument(
        "--writers", type=count, default=6, metavar="N", help="processes at a time (default 6)"
    )
    add_seeds(parser, what="of the random moments", scene=False)
    parser.add_argument(
        "--processes",
        action="store_true",
        help="kill simulator, tactiled and reachd while they reach, and check that the arm rests",
    )
    parser.add_argument(
        "--rigs",
        type=count,
        default=1,
        metavar="N",
        help="with --processes: so many simulators, tactileds and reachds at a time (default 1)",
    )
    _add_budget(parser, "with --processes: begin no kill after so many seconds")
    add_report(parser)
    parser.add_argument(
        "--force",
        action="store_true",
        help="with --processes: begin anew, where the file of --out holds an earlier run",
    )
    add_path(parser, "--keep", "keep the logs of failed kills in this folder")
    parser.set_defaults(func=later("tactile_tools.dev.crash:run"))


def _fill_mutation(parser: Parser) -> None:
    parser.description = (
        "Changes the safety gate in small ways and runs its tests on each: what no test fails on "
        "is listed. Needs the tests, so it works only in a checkout. A run that was cut off goes "
        "on from its --out, as long as gate and tests are the same."
    )
    parser.former(limit="patience")
    parser.add_argument(
        "--file",
        nargs="+",
        default=list(GATE_FILES),
        choices=GATE_FILES,
        help="default: all three",
    )
    add_jobs(parser)
    parser.add_argument("--sample", type=count, metavar="N", help="this many, chosen at random")
    add_seeds(parser, what="of the sample", scene=False)
    parser.add_argument(
        "--patience", type=count, default=120, metavar="S", help="s for one mutant (default 120)"
    )
    parser.add_argument(
        "--max-survivors", type=natural, metavar="N", help="exit with 1 when more survive"
    )
    add_report(parser)
    parser.set_defaults(func=later("tactile_tools.dev.mutation:run"))


def _fill_soak(parser: Parser) -> None:
    parser.description = (
        "Runs a tactiled with its log on simulated boards, one of which is pulled out "
        "and plugged in every second. Exit: 0 nothing grew and every board came back; 1 something "
        "did not; 2 bad argument; 3 it could not be run."
    )
    parser.add_argument(
        "--minutes",
        type=positive("min"),
        default=60.0,
        metavar="MIN",
        help="how long (default 60)",
    )
    parser.add_argument(
        "--boards",
        type=whole(least=1, most=SOAKED),
        default=4,
        metavar="N",
        help="how many (default 4)",
    )
    parser.add_argument(
        "--replug",
        type=seconds,
        default=1.0,
        metavar="S",
        help="s from one pulling out to the next (default 1)",
    )
    parser.add_argument(
        "--rate",
        type=hertz,
        default=100.0,
        metavar="HZ",
        help="sample rate of boards that obey (default 100)",
    )
    add_report(parser)
    parser.set_defaults(func=later("tactile_tools.dev.soak:run"))


def _fill_arm_scenes(parser: Parser) -> None:
    parser.description = (
        "Reaches in scenes 0, 1, 2 … with each arm, one after the other, in real processes and "
        "real time: half a minute a reach. The result has success with its 95 % Wilson interval "
        "and the reason of each failure. It is written after each reach; a run that was cut off "
        "goes on. Run it on a machine that does nothing else. Exit: 0 each reach has its row, 2 "
        "bad argument, 3 refused by the system."
    )
    add_out(parser, "result, as JSON", required=True, force="begin anew")
    parser.add_argument(
        "--arm", choices=ARMS, nargs="+", help="arms to compare (default simulated ur)"
    )
    parser.add_argument(
        "--scenes", type=count, default=50, metavar="N", help="how many (default 50)"
    )
    parser.add_argument(
        "--first", type=natural, default=0, metavar="N", help="number of the first (default 0)"
    )
    parser.add_argument(
        "--lockstep",
        action="store_true",
        help="on virtual time instead: the emulated robot's mechanics behind armd's guard, without "
        "its vendor's client and whatever else runs here",
    )
    add_scene(parser)
    add_strategy(parser)
    add_path(parser, "--logs", "folder in which to keep the log of each reach that failed")
    parser.set_defaults(func=later("tactile_tools.dev.arm_scenes:run"))


if __name__ == "__main__":
    sys.exit(main())
