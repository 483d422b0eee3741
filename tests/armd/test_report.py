"""The tables of docs/arm.md are those of docs/results/arms.json."""

from __future__ import annotations

import json

from tests.support import arms_report


def test_page_shows_what_was_measured() -> None:
    text = arms_report.PAGE.read_text(encoding="utf-8")
    report = json.loads(arms_report.RESULT.read_text(encoding="utf-8"))
    assert arms_report.page_with(text, report) == text, "run python -m tests.support.arms_report"
