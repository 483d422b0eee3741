"""Documents: every link works; generated pages and pictures are up to date."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

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
