"""The page in a real browser: what a person sees and clicks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import tactile_reach as tr

WIDE = {"width": 1280, "height": 900}
PHONE = {"width": 390, "height": 844}
SLOW_MS = 90_000


def open_page(browser: Any, address: str, **options: Any) -> tuple[Any, list[str]]:
    page = browser.new_context(**{"viewport": WIDE} | options).new_page()
    page.set_default_timeout(SLOW_MS)
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda m: troubles.append(m.text) if m.type == "error" else None)
    page.goto(address)
    page.locator(".board .state", has_text="streaming").wait_for()
    return page, troubles


def test_values_on_the_page_are_those_on_the_bus(browser: Any, rig: Any) -> None:
    page, troubles = open_page(browser, rig.page())
    with tr.connect(rig.endpoint, find_s=60) as bus:
        stream = bus.board("pad").features(queue=5000, timeout_s=60)
        next(stream)
        heard: dict[int, float] = {}
        for _ in range(50):
            cell = page.locator('.board[data-name="pad"] .normal')
            seen = cell.evaluate("e => [e.dataset.seq, e.dataset.value, e.textContent]")
            while (f := stream.get(0.3)) is not None:
                heard[f.sequence] = f.normal_force
                if f.sequence >= int(seen[0]) + 5:
                    break
            if int(seen[0]) in heard:
                break
    number, value, text = seen
    assert float(value) == pytest.approx(heard[int(number)], abs=1e-4)
    assert text == f"{float(value):.2f}" or abs(float(text) - float(value)) <= 0.00501
    page.locator(".rate-value", has_text="Hz").wait_for()
    assert troubles == []


def test_tare_and_record_by_click_while_another_watches(browser: Any, rig: Any) -> None:
    address = rig.page()
    page, troubles = open_page(browser, address)
    other, _ = open_page(browser, address)
    page.locator(".called").fill("by-click")
    page.get_by_role("button", name="Record").click()
    page.locator(".notice", has_text="recording to").wait_for()
    other.locator(".record .word", has_text="Stop").wait_for()
    other.locator(".record .go").click()
    other.locator(".notice", has_text="messages in").wait_for()
    page.locator(".record .word", has_text="Record").wait_for()
    assert (rig.folder / "logs" / "by-click.mcap").exists()
    page.locator(".called").fill("../elsewhere")
    page.get_by_role("button", name="Record").click()
    page.locator(".notice", has_text="cannot be the name").wait_for()
    page.get_by_role("button", name="Tare", exact=True).click()
    page.locator(".notice:not(:has-text('leave the skin untouched…'))").wait_for()
    assert troubles == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [WIDE, PHONE], ids=["desktop", "phone"])
def test_it_fits_the_screen_and_nothing_overlaps(
    browser: Any, rig: Any, scheme: str, size: dict[str, int], tmp_path: Path
) -> None:
    page, troubles = open_page(
        browser, rig.page(), viewport=size, color_scheme=scheme, has_touch=size is PHONE
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    boxes = page.locator(".board .head > *, .board .actions > *, .board .facts > div")
    overlaps = boxes.evaluate_all(
        """all => all.flatMap((a, i) => all.slice(i + 1).filter(b => {
             if (a.contains(b) || b.contains(a)) return false;
             const p = a.getBoundingClientRect(), q = b.getBoundingClientRect();
             return p.left < q.right - 1 && q.left < p.right - 1 && p.top < q.bottom - 1
               && q.top < p.bottom - 1 && p.width && q.width;
           }).map(b => a.className + " / " + b.className))"""
    )
    assert overlaps == []
    page.screenshot(path=tmp_path / "page.png")
    assert troubles == []


def test_killed_daemon_is_described_in_words(browser: Any, make_rig: Any) -> None:
    rig = make_rig()
    page, _ = open_page(browser, rig.page())
    rig.daemon.end()
    page.locator(".reasons", has_text="tactiled has stopped: start it again").wait_for()
    rig.start_daemon()
    page.locator(".board .state", has_text="streaming").wait_for()


def test_without_a_daemon_it_says_how_to_start_one(browser: Any, rig: Any, tmp_path: Path) -> None:
    view = rig.start(
        str(Path(rig.daemon.process.args[0]).with_name("tactile")), "view", "--port", "0",
        "--connect", f"unixsock-stream/{tmp_path}/none.sock",
    )  # fmt: skip
    address = view.wait_for("http://").strip()
    page = browser.new_page()
    page.set_default_timeout(SLOW_MS)
    page.goto(address)
    page.locator("#empty", has_text="tactiled --port").wait_for()
