"""Documents: every link works; generated pages and pictures are up to date."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from armd.cli import teach_parser
from tactile_core.daemon import Shutdown
from tactile_tools.completion import parsers
from tactile_tools.dev import architecture, topics_page
from tests.support.paths import ROOT

DOCUMENTS = sorted(
    path
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/**/README.md"))
    if not any(part.startswith(".") or part == "build" for part in path.relative_to(ROOT).parts)
)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a Markdown file."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    found = set()
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        words = re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        found.add(re.sub(r"[^\w\- ]", "", words).replace(" ", "-"))
    return found


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_document_links_exist(path: Path) -> None:
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    for link in LINK.findall(text):
        if "://" in link or link.startswith("mailto:"):
            continue
        target, _, anchor = link.partition("#")
        whole = path if not target else (path.parent / target).resolve()
        assert whole.exists(), f"{link} does not exist"
        if anchor and whole.suffix == ".md":
            assert anchor in anchors(whole), f"{link}: no such heading"


SHELL = re.compile(r"^```(?:sh|bash)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:sudo )?(?:\.venv/bin/)?((?:tactile|tactiled|reachd|simdevice|armd) .*)")


def commands(path: Path) -> list[list[str]]:
    """Our commands in the shell blocks of a Markdown file, as words."""
    found = []
    for block in SHELL.findall(path.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            match = COMMAND.match(line.strip())
            if match is not None:
                words = shlex.split(match[1].replace("…", ""), comments=True)
                found.append([word for word in words if word != "&"])
    return found


def test_every_command_of_the_documents_has_options_that_exist(
    capsys: pytest.CaptureFixture[str],
) -> None:
    known = {parser.prog: parser for parser in parsers()}
    count = 0
    for path in DOCUMENTS:
        for words in commands(path):
            parser, rest = known[words[0]], words[1:]
            if words[:2] == ["armd", "teach"]:
                parser, rest = teach_parser(Shutdown()), words[2:]
            try:
                parser.parse_args(rest)
            except SystemExit as ended:
                refused = f"{path}: {shlex.join(words)}\n" if ended.code else ""
            else:
                refused = ""
            said = capsys.readouterr().err
            assert not refused, refused + said
            assert "is now called" not in said, said
            count += 1
    assert count > 50


def test_structure_pictures_are_up_to_date() -> None:
    for name, svg in architecture.pictures(architecture.read_structure()).items():
        kept = (ROOT / "docs" / "pictures" / name).read_text(encoding="utf-8")
        # Line counts change with every commit; only the imports must agree.
        assert without_counts(kept) == without_counts(svg), f"{name}: run `make pictures`"


def without_counts(svg: str) -> str:
    return re.sub(r"(· |>)[\d,]+( lines)?", r"\1", svg)


def test_topics_page_is_up_to_date() -> None:
    kept = (ROOT / "docs" / "topics.md").read_text(encoding="utf-8")
    assert kept == topics_page.page(), "run `make pictures`"


@pytest.mark.skipif(find_spec("mkdocs") is None, reason="mkdocs is not installed: `make docs`")
def test_site_builds_without_warnings(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "faults.html").is_file()
