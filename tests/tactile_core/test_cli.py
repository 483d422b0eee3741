"""Command lines of all commands: consistent options, fast start, clear errors."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from armd.cli import main as armd_main
from reachd import arguments as reachd_arguments
from reachd.cli import main as reachd_main
from reachd.strategies.parameters import SETS
from reachd.strategies.runner import BUILT_IN
from sim_device import arguments as simdevice_arguments
from sim_device.board.anyskin import SKETCHES
from sim_device.board.slcan_adapter import DIALECTS
from sim_device.cli import main as simdevice_main
from tactile_core import cli
from tactile_core.bus.rights import CERTIFICATE_ROLES
from tactile_tools import cli as tactile_cli
from tactile_tools.cli import main as tactile_main
from tactile_tools.completion import parsers, script
from tactile_tools.dev.mutation import FILES
from tactiled.cli import main as tactiled_main

ROOTS = parsers()
EVERY = [each for root in ROOTS for each in cli.load_all(root)]

MEANINGS = {
    "--board": {"NAME"},
    "--kind": {"KIND", "finger, anyskin"},
    "--arm": {"NAME", "simulated, ur, xarm"},
    "--at": {"TIME"},
    "--calibration": {"FILE", "PATH"},
    "--config": {"FILE"},
    "--depth": {"contacts, taxels"},
    "--duration": {"S"},
    "--engine": {"mujoco, planar, pymunk, pybullet"},
    "--force": {"flag"},
    "--format": {"png, pdf, svg", "csv, parquet, npz, lerobot"},
    "--from": {"TIME"},
    "--until": {"TIME"},
    "--jobs": {"N"},
    "--json": {"flag"},
    "--limit": {"N"},
    "--log": {"PATH"},
    "--name": {"NAME", "TEXT"},  # name on the bus; name on the leaderboard
    "--out": {"PATH"},
    "--png": {"PATH"},
    "--port": {"P", "N"},  # port of a board; TCP port of a page or viewer
    "--rate": {"HZ"},
    "--reach": {"NAME", "N"},  # name on the bus; number within a log
    "--scene": {"SCENE"},
    "--scene-seed": {"N"},
    "--seed": {"N"},
    "--serial": {"HEX"},
    "--set": {"SET"},
    "--source": {"SCENE"},
    "--speed": {"X"},
    "--strategy": {"NAME"},
    "--wait": {"flag", "S"},  # limit for what is missing; the daemon of boards waits without limit
}
"""Values of an option in every command that has it.

Options of a single command need no row, nor do those whose commands agree.
"""

VALUES = ("-0.25,0.1,0", "-.5,1", "-30deg/10s", "-5", "-1e-3", "-inf", "-NaN", "-0.1")

MAINS = {
    "tactile": tactile_main,
    "tactiled": tactiled_main,
    "reachd": reachd_main,
    "armd": armd_main,
    "simdevice": simdevice_main,
}

SLOW = (
    "numpy", "zenoh", "mcap", "msgspec", "rich", "can", "serial", "rosbags", "zstandard", "mujoco",
    "matplotlib", "scipy", "sklearn", "pyarrow", "jinja2", "cryptography", "psutil",
    "numba",
)  # fmt: skip
"""Modules that no command may import for --help."""


def run(capsys: pytest.CaptureFixture[str], line: str) -> tuple[int, str]:
    command, *words = line.split()
    try:
        code = MAINS[command](words)
    except SystemExit as stop:
        code = int(stop.code or 0)
    told = capsys.readouterr()
    return code, told.err


def takes(action: argparse.Action) -> str:
    if action.nargs == 0:
        return "flag"
    if isinstance(action.metavar, str):
        return action.metavar
    assert action.choices is not None, f"{action.option_strings} names nothing that it takes"
    return ", ".join(map(str, action.choices))


def test_options_mean_the_same_in_every_command() -> None:
    found: dict[str, set[str]] = defaultdict(set)
    for parser in EVERY:
        for action in parser._actions:
            if action.help == argparse.SUPPRESS:
                continue
            for option in action.option_strings:
                found[option].add(takes(action))
    for option, kinds in found.items():
        allowed = MEANINGS.get(option)
        if allowed is None:
            assert len(kinds) == 1, f"{option} takes {kinds}: add it to the table, or rename it"
        else:
            assert kinds <= allowed, f"{option} takes {kinds - allowed}"
    assert set(MEANINGS) <= set(found)


def test_former_names_do_not_clash() -> None:
    for parser in EVERY:
        assert isinstance(parser, cli.Parser)
        options = {o for action in parser._actions for o in action.option_strings}
        for former, now in parser.former_names.items():
            assert now in options, f"{parser.prog}: {former} leads nowhere"
            assert former not in options or former == "--board", f"{parser.prog}: {former} is both"


def test_former_name_works_with_a_note(
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = tactile_cli.make_parser().parse_args(["log", "cat", "x.mcap", "--to=3"])
    assert options.last_time == "3"
    assert "--to is now called --until" in capsys.readouterr().err


def test_option_values_match_the_code() -> None:
    assert tuple(BUILT_IN) == cli.STRATEGIES
    assert set(SETS) == set(cli.SETS)
    assert tuple(DIALECTS) == simdevice_arguments.DIALECTS
    assert tuple(SKETCHES) == simdevice_arguments.SKETCHES
    assert CERTIFICATE_ROLES == tactile_cli.ROLES
    assert tuple(FILES) == tactile_cli.GATE_FILES
    text = reachd_arguments.make_parser().format_help()
    for name, values in SETS.items():
        assert f"{name} {values.goal_radius:g}" in " ".join(text.split())
        assert f"{name} {values.time_limit:g}" in " ".join(text.split())


@pytest.mark.parametrize("parser", EVERY, ids=lambda parser: parser.prog)
def test_negative_values_are_not_mistaken_for_flags(parser: argparse.ArgumentParser) -> None:
    flags = [flag for action in parser._actions for flag in action.option_strings]
    for value in VALUES:
        assert parser._parse_optional(value) is None, value
    for flag in flags:
        assert parser._parse_optional(flag) is not None, flag


@pytest.mark.parametrize("parser", EVERY, ids=lambda parser: parser.prog)
def test_commands_are_listed_with_one_line_each(
    parser: argparse.ArgumentParser, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = parser.format_help().splitlines()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                said = [line for line in lines if line.split()[:1] == [choice.dest]]
                assert len(said) == 1
                assert said[0].endswith((choice.help or "").split()[-1])


@pytest.mark.parametrize(
    "line", ["tactile", "tactile log", "tactile experiment", "tactile calibrate", "simdevice"]
)
def test_command_without_arguments_lists_subcommands(
    line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = run(capsys, line)
    assert code == cli.USAGE
    assert "commands:" in said


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("tactile lgo", "unknown command 'lgo'; did you mean log?"),
        ("tactile log catt x.mcap", "did you mean cat?"),
        ("tactile log cat x.mcap --topik a", "unknown option --topik; did you mean --topic?"),
        ("tactiled --prot /dev/x", "did you mean --port?"),
        ("tactiled --port x --compensation consenus", "did you mean consensus?"),
        ("armd --driver urr", "did you mean ur?"),
        ("simdevice cupboard --engine mujocco", "did you mean mujoco?"),
        ("reachd --home --target 0.1,0", "--home: expected one argument"),
        ("tactile calibrate record --out x.mcap --board anyskin", "give it with --kind"),
        ("tactile health --wait never", "allowed: a finite number of s above 0"),
    ],
)
def test_unknown_word_gets_one_sentence_with_suggestion(
    line: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = run(capsys, line)
    assert code == cli.USAGE
    assert hint in said
    assert len(said.strip().splitlines()) == 1


def test_help_and_version_import_no_slow_module() -> None:
    lines = [each.prog.split() for each in EVERY]
    code = f"""
import contextlib, io, json, sys
from importlib import import_module
loaded = {{}}
for line in json.loads({json.dumps(json.dumps(lines))}):
    module = {{"tactile": "tactile_tools", "simdevice": "sim_device"}}.get(line[0], line[0])
    for flag in ("--help", "--version"):
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
            import_module(module + ".cli").main([*line[1:], flag])
        for name in {SLOW!r}:
            if name in sys.modules:
                loaded.setdefault(name, " ".join([*line, flag]))
print(json.dumps(loaded))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {}


HIDDEN = tuple(cli.EXTRAS)


@pytest.fixture(scope="module")
def core_only(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment without any extra, for processes and their children."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "sitecustomize.py").write_text(
        f"import sys\nfor name in {HIDDEN!r}:\n    sys.modules[name] = None\n"
    )
    return os.environ | {"PYTHONPATH": str(folder)}


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (("tactile_tools.cli", "plot", "x.mcap"), "plot"),
        (("tactile_tools.cli", "demo"), "sim"),
        (("tactile_tools.cli", "demo-skin"), "plot"),
        (("tactile_tools.cli", "reach"), "sim"),
        (("tactile_tools.cli", "reach", "--log", "x.mcap", "--png", "x.png"), "plot"),
        (("tactile_tools.cli", "fidelity"), "sim"),
        (("tactile_tools.cli", "log", "export", "x.mcap", "--format", "parquet"), "export"),
        (("tactile_tools.cli", "calibrate", "fit", "x", "--out", "x.cal.toml"), "calibrate"),
        (("tactile_tools.cli", "calibrate", "evaluate", "x"), "calibrate"),
        (("tactile_tools.cli", "experiment", "strategies"), "experiments"),
        (("tactile_tools.cli", "experiment", "report", "x"), "experiments"),
        (("tactile_tools.cli", "experiment", "compare", "x", "y"), "experiments"),
        (("tactile_tools.cli", "experiment", "trial"), "sim"),
        (("tactile_tools.cli", "bus", "keys", "lab"), "keys"),
        (("tactile_tools.cli", "completion", "bash"), "completion"),
        (("sim_device.cli", "cupboard"), "sim"),
        (("tactiled.cli", "--port", "x", "--compensation", "ransac"), "calibrate"),
    ],
    ids=" ".join,
)
def test_missing_extra_is_named_in_one_sentence(
    words: tuple[str, ...], extra: str, core_only: dict[str, str], tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *words], capture_output=True, text=True, env=core_only, cwd=tmp_path
    )
    assert done.returncode == cli.USAGE, done.stderr
    assert f"pip install 'tactile-reach[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr
    assert [path for path in tmp_path.iterdir() if path.name != "runs"] == []


def test_daemons_need_no_extra(core_only: dict[str, str]) -> None:
    modules = ("tactiled.daemon", "tactiled.status", "reachd.daemon", "reachd.strategies",
               "sim_device.runner", "sim_device.ports_plan", "tactile_tools.log.info",
               "tactile_tools.operate.status", "tactile_tools.operate.health",
               "tactile_tools.operate.service")  # fmt: skip
    code = "import " + ", ".join(modules)
    subprocess.run([sys.executable, "-c", code], env=core_only, check=True)


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completion_covers_commands_options_and_choices(tmp_path: Path) -> None:
    pytest.importorskip("shtab", reason="the extra `completion` is not installed")
    file = tmp_path / "completion.bash"
    file.write_text(script("bash"))
    program = f"""
source {file}
try() {{
  COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 )); COMPREPLY=()
  "_shtab_$1" "$1" "${{COMP_WORDS[$COMP_CWORD]}}" ""
  echo "${{COMPREPLY[@]}}"
}}
try tactile lo; try tactile log cat --un; try tactiled --compensation r; try simdevice boa
"""
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["log", "--until", "ransac", "boards"]


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish_completes_commands_options_choices_and_files(tmp_path: Path) -> None:
    pytest.importorskip("shtab", reason="the extra `completion` is not installed")
    (tmp_path / "completion.fish").write_text(script("fish"))
    (tmp_path / "reach.mcap").touch()
    lines = ("tactile lo", "tactile log cat --un", "tactiled --compensation r", "simdevice boa",
             "armd --driver fl", "tactile plot rea")  # fmt: skip
    program = "source completion.fish\n" + "\n".join(f"complete -C '{line}'" for line in lines)
    done = subprocess.run(
        ["fish", "--no-config", "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env=os.environ | {"HOME": str(tmp_path)},
    )
    rows = [row.split("\t") for row in done.stdout.splitlines()]
    assert [row[0] for row in rows] == [
        "log",
        "--until",
        "ransac",
        "boards",
        "flexiv",
        "reach.mcap",
    ]
    assert rows[0][1] == "inspect, repair, convert, replay and reprocess MCAP logs"
