"""docs/configuration.md is generated from the schemas and explains every key."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactile_core.config import describe
from tactile_tools.dev.config_reference import FILES, main
from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "configuration.md"


def test_configuration_page_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(PAGE), "--check"]) == 0, capsys.readouterr().err


def test_stale_page_is_named_with_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "configuration.md"
    assert main([str(page), "--check"]) == 1
    assert "make docs-reference" in capsys.readouterr().err
    assert main([str(page)]) == 0
    assert main([str(page), "--check"]) == 0


@pytest.mark.parametrize("title", [title for title, _, _ in FILES])
def test_every_key_has_a_type_and_a_meaning(title: str) -> None:
    schema = next(schema for name, _, schema in FILES if name == title)
    keys = [key for section in describe(schema) for key in section.keys]
    assert keys
    assert [key.name for key in keys if not key.type or not key.meaning] == []
