"""Command lines: parser, value parsers, common options, exit codes, live lines, progress bars.

Only what argparse needs is imported at the top. rich and other slow modules are imported where they
are used, so that ``--help`` of any command answers at once.
"""

from __future__ import annotations

import argparse
import logging
import math
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, NoReturn, Self, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tactile_core.log.recorder import Recorder

log = logging.getLogger(__name__)

T = TypeVar("T")

DONE, FAILED, USAGE, REFUSED = range(4)
"""Exit status: done; not done; bad argument or configuration; refused by hardware, peer or
system."""

INTERRUPTED, PIPE_CLOSED = 130, 141
"""Exit status after Ctrl-C, and after the reader of the output has gone (as in shells)."""

DISTRIBUTION = "tactile-reach"

DEFAULT_LOG = "tactile-logs"
"""Default folder of the logs, in the working folder of the daemon."""


class CommandError(Exception):
    """The command cannot do what was asked; the text is one sentence that names the remedy.

    ``code``: the exit status.
    """

    def __init__(self, text: str, code: int = USAGE) -> None:
        super().__init__(text)
        self.code = code


# Optional packages

EXTRAS: Final[Mapping[str, str]] = {
    "mujoco": "sim",
    "matplotlib": "plot",
    "mpl_toolkits": "plot",
    "pyarrow": "export",
    "scipy": "calibrate",
    "sklearn": "calibrate",
    "jinja2": "experiments",
    "cryptography": "keys",
    "numba": "train",
    "pymunk": "crosscheck",
    "pybullet": "reference",
    "distributed": "dask",
    "shtab": "completion",
}
"""Optional modules, and the extra of this project that installs each."""


class MissingExtraError(CommandError):
    """An optional module is not installed; the text says how to install it."""


def require(*modules: str, extra: str, what: str = "") -> None:
    """Check that optional ``modules`` can be imported; raises `MissingExtraError` otherwise.

    ``extra``: the extra that installs them. ``what``: what needs them, if not the command itself.
    """
    from importlib.util import find_spec

    for module in modules:
        if find_spec(module) is None:
            raise MissingExtraError(_needs(module, extra, what))


def missing_extra(error: ModuleNotFoundError) -> MissingExtraError | None:
    """Error for a failed import if one of our extras installs the module, otherwise None."""
    module = (error.name or "").partition(".")[0]
    extra = EXTRAS.get(module)
    return None if extra is None else MissingExtraError(_needs(module, extra))


def _needs(module: str, extra: str, what: str = "") -> str:
    name = {"sklearn": "scikit-learn"}.get(module, module)
    subject = f"{what} needs" if what else "needs"
    return f"{subject} {name}, which is not installed: pip install '{DISTRIBUTION}[{extra}]'"


# The parser

_NEGATIVE = re.compile(r"-(?:\.?\d|inf\b|nan\b)", re.IGNORECASE)
"""Start of a value with a minus, such as -0.25,0.1,0 or -30deg/10s, which is never a flag of
ours."""

_LIMIT = 60
"""Most characters of a wrong value quoted in an error message."""


class Formatter(argparse.HelpFormatter):
    """Wraps text except where it contains line breaks; aligns lists of commands."""

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog, **({"max_help_position": 26} | options))

    def add_argument(self, action: argparse.Action) -> None:
        """Add a line.

        Commands are indented two columns more, which argparse does not account for.
        """
        super().add_argument(action)
        if isinstance(action, argparse._SubParsersAction):
            self._action_max_length += 2

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" not in text.strip():
            return super()._fill_text(text, width, indent)
        return "".join(indent + line for line in text.splitlines(keepends=True))


class Parser(argparse.ArgumentParser):
    """Parser of every command and subcommand.

    Beyond argparse: a value may begin with a minus (``--home -0.25,0.1,0``); unknown arguments are
    rejected by the subcommand that got them, in one sentence with a suggestion; former names of
    options still work and print the current name (`former`).
    """

    def __init__(self, *words: Any, **options: Any) -> None:
        options.setdefault("formatter_class", Formatter)
        super().__init__(*words, **options)
        self._negative_number_matcher = _NEGATIVE
        self._former: dict[str, str] = {}
        self._version = self.add_argument(
            "--version", action=_Version, nargs=0, help=argparse.SUPPRESS
        )

    def show_version(self) -> None:
        """List --version in the help; every parser accepts it."""
        self._version.help = "print the version, and exit"

    def former(self, **names: str) -> None:
        """Accept former names of options: ``former(to="until")`` for --to, now --until."""
        for old, new in names.items():
            self._former[f"--{old.replace('_', '-')}"] = f"--{new.replace('_', '-')}"

    @property
    def former_names(self) -> Mapping[str, str]:
        """Former names of options and their current names."""
        return dict(self._former)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse and, unlike argparse, reject unknown arguments. Also called for subcommands."""
        words = self._renamed(list(sys.argv[1:] if args is None else args))
        namespace, rest = super().parse_known_args(words, namespace)
        if rest:
            self.error(self._unknown(str(rest[0])))
        return namespace, rest

    def error(self, message: str) -> NoReturn:
        """Reject a command line with one sentence that points to the help; exit status 2."""
        self.exit(USAGE, f"{self.prog}: {message} (see `{self.prog} --help`)\n")

    def _renamed(self, words: list[str]) -> list[str]:
        for at, word in enumerate(words):
            if word == "--":
                break
            option, equals, value = word.partition("=")
            if option in self._former:
                now = self._former[option]
                print(f"{self.prog}: note: {option} is now called {now}", file=sys.stderr)
                words[at] = now + equals + value
        return words

    def _unknown(self, word: str) -> str:
        if not word.startswith("-"):
            return f"unexpected argument {shown(word)}"
        option = word.partition("=")[0]
        known = [
            name
            for action in self._actions
            if action.help != argparse.SUPPRESS
            for name in action.option_strings
            if name.startswith("--")
        ]
        return f"unknown option {shown(option)[1:-1]}{did_you_mean(option, known)}"

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        choices = action.choices
        if choices is None or value in choices:
            return
        known = [str(choice) for choice in choices]
        hint = did_you_mean(str(value), known)
        listed = ", ".join(known)
        if isinstance(action, argparse._SubParsersAction):
            raise argparse.ArgumentError(
                None, f"unknown command {shown(value)}{hint or f'; available: {listed}'}"
            )
        raise argparse.ArgumentError(action, f"{shown(value)} given{hint}; allowed: {listed}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``; did you mean X?`` if ``known`` has something similar to ``word``, otherwise empty."""
    close = get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else ""


class _Version(argparse.Action):
    """Prints the version, determined only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"{parser.prog.split()[0]} {version(DISTRIBUTION)}")
        parser.exit(DONE)


# Subcommands, loaded on use


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand. ``help``: one line; ``fill``: "module" or "module:function".

    The function (default name ``fill``) receives the parser, adds the options and sets the default
    ``func``, which takes the parsed options and returns the exit status.
    """

    help: str
    fill: str


class _Commands(argparse._SubParsersAction):  # type: ignore[type-arg]  # generic in the stubs alone
    """Subcommands that get their options on use."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        self.waiting: dict[str, Command] = {}

    def load(self, name: str) -> None:
        """Import the module of ``name`` and let it fill the parser, once."""
        command = self.waiting.pop(name, None)
        if command is not None:
            module, _, function = command.fill.partition(":")
            getattr(import_module(module), function or "fill")(self.choices[name])

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        self.load(values[0])
        super().__call__(parser, namespace, values, option_string)


def add_commands(
    parser: argparse.ArgumentParser, commands: Mapping[str, Command], title: str = "commands"
) -> None:
    """Add subcommands. Called without one, the command lists them and exits with 2."""
    action = parser.add_subparsers(title=title, metavar="COMMAND", action=_Commands)
    assert isinstance(action, _Commands)
    for name, command in commands.items():
        action.add_parser(name, help=command.help)
        action.waiting[name] = command

    def list_them(_: argparse.Namespace) -> int:
        parser.print_help(sys.stderr)
        return USAGE

    parser.set_defaults(func=list_them)


def later(place: str, *needed: str, extra: str = "") -> Callable[[argparse.Namespace], int]:
    """Wrap the function "module:function" so that it is imported when called.

    ``needed``: optional modules that it imports, installed by ``extra``.
    """

    def call(options: argparse.Namespace) -> int:
        if needed:
            require(*needed, extra=extra)
        module, _, function = place.partition(":")
        try:
            found = import_module(module)
        except ModuleNotFoundError as error:
            # Wheels leave out what only tests the project itself.
            if not f"{module}.".startswith(f"{error.name}."):
                raise
            raise CommandError(
                "this command tests the project itself and is not installed with it: run it in a "
                "checkout, after `make setup`"
            ) from None
        code: int = getattr(found, function)(options)
        return code

    return call


def load_all(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """Load every subcommand at any depth; returns all parsers."""
    found = [parser]
    for action in parser._actions:
        if isinstance(action, _Commands):
            for name, each in action.choices.items():
                action.load(name)
                found += load_all(each)
    return found


def run_command(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None, prog: str | None = None
) -> int:
    """Parse ``argv``, run the command and return its exit status. Errors are one sentence on
    stderr.

    ``prog``: start of the sentence (default: name of the parser).
    """
    options = parser.parse_args(argv)
    try:
        code: int = options.func(options)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of the output (head, less) has gone: end quietly, without a traceback.
        sys.stderr.close()
        return PIPE_CLOSED
    except CommandError as error:
        return complain(prog or _prog_of(parser, argv), error)
    except ModuleNotFoundError as error:
        missing = missing_extra(error)
        if missing is None:
            raise
        return complain(prog or _prog_of(parser, argv), missing)
    return code


def complain(prog: str, error: CommandError) -> int:
    """Print the error and return its exit status.

    The text may contain data from a log or a peer, so anything that a terminal would interpret is
    escaped.
    """
    text = "".join(
        letter
        if letter.isprintable() or letter == "\n"
        else letter.encode("unicode_escape", "backslashreplace").decode()
        for letter in str(error)
    )
    print(f"{prog}: {text}", file=sys.stderr)
    return error.code


def _prog_of(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> str:
    """Name of the subcommand in ``argv``, such as ``tactile log cat``."""
    words = iter(sys.argv[1:] if argv is None else argv)
    while True:
        action = next((a for a in parser._actions if isinstance(a, _Commands)), None)
        name = None if action is None else next((w for w in words if w in action.choices), None)
        if action is None or name is None:
            return parser.prog
        parser = action.choices[name]


# Value parsers


def shown(value: object) -> str:
    """A rejected value, quoted and shortened for a message."""
    text = str(value)
    return repr(text) if len(text) <= _LIMIT else f"{text[:_LIMIT]!r}…"


def refuse(text: str, allowed: str) -> argparse.ArgumentTypeError:
    """Error for a value that is not ``allowed`` (in words)."""
    return argparse.ArgumentTypeError(f"{shown(text)} given; allowed: {allowed}")


def number(
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
) -> Callable[[str], float]:
    """Parser of a finite number of ``unit`` within the given bounds."""
    bounds = [f"above {above:g}"] if above is not None else []
    if least is not None and most is not None:
        bounds.append(f"from {least:g} to {most:g}")
    elif least is not None:
        bounds.append(f"at least {least:g}")
    elif most is not None:
        bounds.append(f"at most {most:g}")
    of_unit = f" of {unit}" if unit else ""
    allowed = f"a finite number{of_unit} {', '.join(bounds)}".rstrip()
    low = -math.inf if least is None else least
    high = math.inf if most is None else most

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or not low <= value <= high:
            raise refuse(text, allowed)
        if above is not None and not value > above:
            raise refuse(text, allowed)
        return value

    return parse


def positive(unit: str) -> Callable[[str], float]:
    """Parser of a finite number of ``unit`` above 0."""
    return number(unit, above=0)


def whole(unit: str = "", *, least: int = 0, most: int | None = None) -> Callable[[str], int]:
    """Parser of a whole number of ``unit`` from ``least`` to ``most``."""
    limit = f"from {least} to {most}" if most is not None else f"of at least {least}"
    if unit:
        limit = f"of {unit} " + limit.replace("of ", "", 1)
    allowed = f"a whole number {limit}"

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdecimal()) or len(text) > 20:
            raise refuse(text, allowed)
        value = int(text)
        if value < least or (most is not None and value > most):
            raise refuse(text, allowed)
        return value

    return parse


seconds = positive("s")
hertz = positive("Hz")
count = whole(least=1)
natural = whole()
seed = whole(most=2**63 - 1)
fraction = number(least=0, most=1)


def speed(text: str) -> float:
    """Parser of a speed in multiples of real time: above 0, or inf."""
    return math.inf if text.lower() == "inf" else positive("times real time")(text)


def checked(parse: Callable[[str], T]) -> Callable[[str], T]:
    """Adapt ``parse`` for argparse, so that the text of its ValueError is shown."""

    def convert(text: str) -> T:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return convert


def loaded(place: str) -> Callable[[str], Any]:
    """Parser "module:function", imported on first use; the text of its ValueError is shown."""

    def convert(text: str) -> Any:
        module, _, function = place.partition(":")
        return checked(getattr(import_module(module), function))(text)

    return convert


def named_value(text: str) -> tuple[str, str]:
    """Parser of NAME=VALUE; returns name and value."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise refuse(text, "NAME=VALUE")
    return name.strip(), value


# Options shared by several commands

Adding = argparse._ActionsContainer


def add_out(
    parser: Adding, what: str, *, required: bool = False, force: str = "overwrite what is there"
) -> None:
    """Add --out, and --force unless ``force`` is empty."""
    add_path(parser, "--out", what, required=required)
    if force:
        parser.add_argument("--force", action="store_true", help=force)


def add_path(parser: Adding, option: str, what: str, **options: Any) -> None:
    """Add an option that takes a path."""
    from pathlib import Path

    parser.add_argument(option, type=Path, metavar="PATH", help=what, **options)


def add_json(parser: Adding, what: str = "print JSON on standard output") -> None:
    """Add --json, a flag."""
    parser.add_argument("--json", action="store_true", help=what)


def add_seeds(
    parser: Adding, *, default: int = 0, what: str = "of the trial's chance", scene: bool = True
) -> None:
    """Add --seed and --scene-seed; `seeds_of` resolves them."""
    shown_default = f"(default {default})" if not scene else f"(default: --scene-seed, {default})"
    parser.add_argument(
        "--seed",
        type=seed,
        default=None if scene else default,
        metavar="N",
        help=f"{what} {shown_default}",
    )
    if scene:
        parser.add_argument(
            "--scene-seed", type=seed, metavar="N", help="of the scene (default: --seed)"
        )


def seeds_of(options: argparse.Namespace, default: int = 0) -> tuple[int, int]:
    """Seeds of scene and trial; if only one is given, it serves as both."""
    scene, trial = options.scene_seed, options.seed
    if scene is None:
        scene = default if trial is None else trial
    return scene, scene if trial is None else trial


def add_strategies(parser: Adding, what: str) -> None:
    """Add --strategy, which may be repeated."""
    parser.add_argument("--strategy", nargs="+", action="extend", metavar="NAME", help=what)


def add_board(parser: Adding, what: str, **options: Any) -> None:
    """Add --board, the name of a board."""
    parser.add_argument("--board", metavar="NAME", help=f"name of the board {what}", **options)


# Names that options accept. A test keeps them equal to the code, whose modules are slow to import.

KINDS: Final = ("auto", "tactile", "anyskin", "reskin", "eflesh")
"""Values of --kind besides a layout; the last three mean the same boards."""

PAPER_STRATEGIES: Final = ("straight", "burrow", "excavate", "hybrid_clock", "hybrid_event")
"""The paper's strategies, which its experiments compare."""

STRATEGIES: Final = (*PAPER_STRATEGIES, "quick_sweep", "learned")
"""Strategies that come with reachd."""

DEFAULT_STRATEGY: Final = "hybrid_event"
"""The best strategy of the paper."""

SETS: Final = ("hardware", "authors_sim")
"""Parameter sets."""


def add_log_and_bus(parser: argparse.ArgumentParser, role: str) -> None:
    """Add --log, --no-log, --listen, --connect, --keys and --insecure, for a daemon's ``role``."""
    group = parser.add_argument_group("log and bus")
    add_path(
        group,
        "--log",
        f"MCAP file to write, or folder for dated files (default folder ./{DEFAULT_LOG})",
    )
    group.add_argument("--no-log", action="store_true", help="log nothing")
    _add_bus(group, role)


def add_bus(parser: argparse.ArgumentParser, role: str) -> None:
    """Add --listen, --connect, --keys and --insecure; ``role``: as `session.Role`."""
    _add_bus(parser.add_argument_group("bus"), role)


def _add_bus(group: Adding, role: str) -> None:
    add = group.add_argument
    default = "nowhere" if role == "tool" else f"{role}.sock in the runtime folder"
    add(
        "--listen",
        action="append",
        metavar="ENDPOINT",
        help="zenoh endpoint to listen at: unixsock-stream//FOLDER/NAME.sock, tcp/127.0.0.1:PORT "
        f"or tls/HOST:PORT (default {default}); may be repeated",
    )
    add(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="zenoh endpoint of a peer to join (default: the others in the runtime folder); may be "
        "repeated",
    )
    add(
        "--keys",
        metavar="FOLDER",
        help="folder of keys, made by `tactile bus keys`: join over TLS, with the rights of its "
        "certificate",
    )
    add(
        "--insecure",
        action="store_true",
        help="no authentication, and endpoints beyond this machine are allowed: "
        "whoever reaches them may read and command; give it to all of a rig or to none",
    )


# Output while a command runs

PLAIN_EVERY_S: Final = 5.0
"""Interval of a daemon's plain status lines without a terminal."""

Report = Callable[[int, int], None]
"""Called with the amount done and the total."""


@contextmanager
def progress(what: str, unit: str = "bytes") -> Iterator[Report | None]:
    """Progress bar on a terminal, removed at the end; yields None elsewhere.

    ``unit``: "bytes" or "items".
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    so_far = DownloadColumn() if unit == "bytes" else MofNCompleteColumn()
    columns = (TextColumn(what), BarColumn(), so_far, TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def working(what: str) -> Iterator[None]:
    """Line with the elapsed time on a terminal, removed at the end; nothing elsewhere."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        bar.add_task(what, total=None)
        yield


class LiveLines(ABC):
    """Display of a running daemon: live lines on a terminal, otherwise a plain line now and then.

    A context manager, used from the main thread. The state of ``recorder``'s log is shown below.
    """

    def __init__(self, console: Console, recorder: Recorder | None = None) -> None:
        from rich.live import Live

        self._recorder = recorder
        self._plain_at = monotonic()
        self._failed = False
        self._live = (
            Live(console=console, auto_refresh=False, transient=True)
            if console.is_terminal
            else None
        )

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self) -> None:
        """Refresh the live lines, or log plain ones when due; call it often.

        An error in the display is logged once and never stops the daemon.
        """
        try:
            self._show()
        except Exception as error:  # a fault of the display must not stop the daemon
            if not self._failed:
                self._failed = True
                log.error("the state cannot be shown", exc_info=error)

    def _show(self) -> None:
        if self._live is not None:
            table = self.table()
            if table is not None:
                self._live.update(self._above_the_log(table), refresh=True)
        elif monotonic() - self._plain_at >= PLAIN_EVERY_S:
            self._plain_at = monotonic()
            for line in self.lines():
                log.info("%s", line)
            if self._recorder is not None:
                log.info("log %s", describe_log(self._recorder))

    @abstractmethod
    def table(self) -> Table | None:
        """Content of the live display; None while there is nothing to show."""

    @abstractmethod
    def lines(self) -> Iterable[str]:
        """Content of the plain lines."""

    def _above_the_log(self, table: Table) -> Table:
        if self._recorder is None:
            return table
        from rich.table import Table
        from rich.text import Text

        good = self._recorder.stats.state == "recording"
        grid = Table.grid()
        grid.add_row(table)
        row = Text(describe_log(self._recorder), "" if good else "red")
        text = Text.assemble(("log ", "dim"), row)
        text.no_wrap, text.overflow = True, "ellipsis"
        grid.add_row(text)
        return grid


def set_up_logging(console: Console, *, verbose: bool) -> None:
    """Log above the live lines on a terminal, otherwise as plain lines with time stamps."""
    level = logging.DEBUG if verbose else logging.INFO
    if console.is_terminal:
        from rich.logging import RichHandler

        handler: logging.Handler = RichHandler(
            console=console, show_path=False, rich_tracebacks=False, markup=False
        )
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


def drops_text(drops: Mapping[str, int]) -> str:
    """Format counts by reason, the largest first."""
    if not drops:
        return "0"
    ordered = sorted(drops.items(), key=lambda item: -item[1])
    listed = " ".join(f"{reason}={n}" for reason, n in ordered[:4])
    return f"{listed} …" if len(ordered) > 4 else listed


def describe_log(recorder: Recorder) -> str:
    """Describe the state of the log in one line."""
    stats = recorder.stats
    text = f"{stats.path}  {stats.bytes_written / 1e6:.1f} MB"
    if stats.state != "recording":
        text += f"  {stats.state.upper()} {stats.last_error}"
    if stats.dropped:
        text += f"  dropped {drops_text(stats.dropped)}"
    return text
