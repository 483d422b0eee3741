"""The umbrella command ``tactile``: one subcommand a tool."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from importlib.metadata import version

from tactile_core.arguments import Parser

TOOLS = {
    "log": "log.cli",
    "plot": "plot.cli",
    "status": "operate.status",
    "tare": "operate.tare",
    "calibrate": "calibrate.cli",
    "reach": "reach.cli",
    "demo": "demo",
    "demo-skin": "demo_skin",
    "bench": "dev.bench",
    "fidelity": "dev.fidelity",
    "experiment": "experiments.cli",
    "fuzz": "dev.fuzz",
    "crash": "dev.crash",
    "mutation": "dev.mutation",
    "bus": "operate.bus",
    "health": "operate.health",
    "service": "operate.service",
    "soak": "dev.soak",
}
"""Subcommand to the module of this package that adds it with ``add_parser(subparsers)``."""


def build_parser(tools: Iterable[str] = TOOLS) -> argparse.ArgumentParser:
    """Return the parser with the subcommands of ``tools``."""
    parser = Parser(
        prog="tactile",
        description="Ask and tare boards, inspect, recover and plot logs, run reaches, demos, "
        "benchmarks and fuzzers, look after a rig.",
    )
    parser.add_argument(
        "--version", action="version", version=f"tactile-reach {version('tactile-reach')}"
    )
    subparsers = parser.add_subparsers(dest="tool", metavar="TOOL", required=True)
    for tool in tools:
        import_module(f"tactile_tools.{TOOLS[tool]}").add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one tool; its exit code is 0 only when the job was done, 2 for a bad argument."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Our matrices are small: threads of the linear algebra gain nothing on them, and on a machine
    # busy with trials they wait for one another far longer than they work. Read at numpy's import.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Only the tool that was named is imported, so that `tactile log` does not wait for matplotlib.
    named = tuple(words[:1]) if words and words[0] in TOOLS else None
    options = build_parser(named or TOOLS).parse_args(words)
    run: Callable[[argparse.Namespace], int] = options.func
    try:
        return run(options)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output (head, less) has gone: nothing more to say, and no traceback.
        sys.stderr.close()
        return 141


if __name__ == "__main__":
    sys.exit(main())
