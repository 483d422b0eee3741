"""Show documents that lie beside the code in the site, and links into the repository as text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
BESIDE = {
    "sensor_proto/PROTOCOL.md": "protocol.md",
    "tests/README.md": "faults.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}
"""File of the repository: its page in the site."""

_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the documents that are not in ``docs``."""
    from mkdocs.structure.files import File

    for source, page in BESIDE.items():
        if (ROOT / source).is_file():
            files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:  # noqa: ARG001 (mkdocs passes them by name)
    """Point links at pages of the site; a link to any other file becomes the file's name."""
    where = {page: (ROOT / source).parent for source, page in BESIDE.items()}
    folder = where.get(page.file.src_uri, (ROOT / "docs" / page.file.src_uri).parent)
    depth = page.file.src_uri.count("/")

    def point(match: re.Match[str]) -> str:
        text, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        if "://" in target or target.startswith("mailto:"):
            return match.group(0)
        path = (folder / target).resolve()
        if not path.is_relative_to(ROOT):
            return match.group(0)
        inside = path.relative_to(ROOT).as_posix()
        if inside in BESIDE:
            return f"[{text}]({'../' * depth}{BESIDE[inside]}{anchor})"
        if inside.startswith("docs/") and path.is_file():
            return f"[{text}]({'../' * depth}{inside.removeprefix('docs/')}{anchor})"
        return text if text.startswith("`") else f"{text} (`{inside}`)"

    return _LINK.sub(point, markdown)
