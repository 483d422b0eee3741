"""Write ``docs/topics.md`` from the table of topics and the message definitions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from tactile_core.bus.topics import TOPICS

HEAD = """# Topics

Written from `tactile_core/bus/topics.py` and the message definitions (`make pictures`).

Keys are zenoh key expressions; the channel of a log has a leading slash. Payloads are ROS 2 \
messages in CDR, the same bytes on the bus and in the log. `NAME` is the board, arm or reach.

| key | type | Hz | on the bus | in the log | too old after |
|---|---|---|---|---|---|
"""


def page() -> str:
    """Whole page as Markdown."""
    text = [HEAD]
    for topic in TOPICS:
        stale = "" if topic.stale_after is None else f"{topic.stale_after:g} s"
        rate = "latched" if topic.latched else f"{topic.rate:g}" if topic.rate else "on events"
        text.append(
            f"| `{topic.template.replace('{name}', 'NAME')}` | `{topic.msgtype}` | {rate} "
            f"| {'yes' if topic.published else 'no'} | {'yes' if topic.logged else 'no'} "
            f"| {stale} |\n"
        )
    text.append("\n## Our message types\n")
    folder = resources.files("tactile_core.bus").joinpath("msg")
    for entry in sorted(folder.iterdir(), key=lambda e: e.name):
        if entry.name.endswith(".msg"):
            name = entry.name.removesuffix(".msg")
            body = entry.read_text(encoding="utf-8").strip()
            text.append(f"\n### tactile_msgs/msg/{name}\n\n```\n{body}\n```\n")
    return "".join(text)


def main(argv: Sequence[str]) -> int:
    """Write the page to the file named."""
    if len(argv) != 1:
        print("usage: python -m tactile_tools.dev.topics_page FILE", file=sys.stderr)
        return 2
    Path(argv[0]).write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
