"""The review page in a real browser, by keyboard alone, against the real server."""

import json
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from data.review.store import REVIEWS_FILE
from tests.review_pairs import write_proposals

ROOT = Path(__file__).parents[1]
CHROMIUM = shutil.which("chromium")
# A busy machine takes its time; nothing here is about speed.
WAIT_S = 120

pytestmark = pytest.mark.slow


@contextmanager
def served(folder: Path, port: int = 0) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """A running server and its address."""
    command = [
        *(sys.executable, "-m", "data.review"),
        *(f"proposals={folder / 'proposals'}", f"reviews={folder / 'reviews'}"),
        *("second_opinion_share=0.0", f"port={port}"),
    ]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as server:
        lines: queue.Queue[str] = queue.Queue()

        def listen() -> None:
            assert server.stderr is not None
            for line in server.stderr:
                lines.put(line)

        threading.Thread(target=listen, daemon=True).start()
        try:
            line = lines.get(timeout=WAIT_S)
            while "event=reviewing" not in line:
                line = lines.get(timeout=WAIT_S)
            yield line.split("url=")[1].split()[0], server
        finally:
            server.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("there is no chromium on this machine")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@contextmanager
def opened_page(browser: Any, url: str, **scheme: str) -> Iterator[Any]:
    """A page of 1360 x 850; at its end it must have had no error, and asked nobody else."""
    faults: list[str] = []

    def note(request: Any) -> None:
        if not request.url.startswith((f"{url}/", "data:")):
            faults.append(request.url)

    context = browser.new_context(viewport={"width": 1360, "height": 850}, **scheme)
    context.set_default_timeout(WAIT_S * 1000)
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", note)
    yield page
    context.close()
    assert not faults


def lines_of(folder: Path) -> list[dict[str, Any]]:
    lines = (folder / "reviews" / REVIEWS_FILE).read_text().splitlines()
    return [json.loads(line) for line in lines]


def shows(page: Any, number: int) -> None:
    """Wait until the pair of this number and its preview are on the page."""
    page.wait_for_selector(f'#instruction:text-is("Sentence number {number}.")')
    page.wait_for_selector("#charts path.edited")


def edited_lines(page: Any) -> list[str]:
    return list(
        page.locator("#charts path.edited").evaluate_all("all => all.map(p => p.outerHTML)")
    )


def until(holds: Callable[[], bool]) -> None:
    """Wait for what no selector can tell."""
    end = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_reviewer_works_by_keyboard_alone(browser: Any, tmp_path: Path) -> None:
    write_proposals(tmp_path / "proposals")
    with served(tmp_path) as (url, _), opened_page(browser, url) as page:
        page.goto(url)
        page.wait_for_selector("#name[open]")
        page.keyboard.type("Ann")
        page.keyboard.press("Enter")
        shows(page, 0)
        assert page.locator("#edit").is_disabled()

        page.keyboard.press("Enter")  # accept
        shows(page, 1)
        assert "1 / 6 done" in page.locator("#progress").inner_text()

        before = edited_lines(page)
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "slider-K_p"
        for _ in range(20):
            page.keyboard.press("ArrowRight")
        page.wait_for_selector("#edit:enabled")
        until(lambda: edited_lines(page)[0] != before[0])
        assert edited_lines(page)[2] == before[2]  # K_p does not steer
        page.keyboard.press("Enter")  # no accept: something was changed
        assert "E saves it" in page.locator("#notice").inner_text()
        page.screenshot(path=tmp_path / "page.png")
        page.keyboard.press("e")
        shows(page, 2)

        page.keyboard.press("1")  # aggressive -> conservative
        page.wait_for_selector("#review[data-style=conservative]")
        assert "drive more gently" in page.locator("#explanation").inner_text()
        page.keyboard.press("Escape")
        assert page.locator("#edit").is_disabled()
        page.keyboard.press("r")
        shows(page, 3)
        page.keyboard.press("u")  # takes the rejection back
        shows(page, 2)
        page.keyboard.press("u")  # and the edit, with what was set
        shows(page, 1)
        assert not page.locator("#edit").is_disabled()
        page.keyboard.press("s")
        shows(page, 2)

    lines = lines_of(tmp_path)
    assert [line["action"] for line in lines] == [
        *("accept", "edit", "reject", "undo", "undo", "skip")
    ]
    assert {line["annotator"] for line in lines} == {"ann"}
    assert lines[1]["values"][0] > lines[5]["values"][0]
    assert lines[1]["values"][1:] == lines[5]["values"][1:]


def test_a_coupled_fault_is_said_and_cannot_be_saved(browser: Any, tmp_path: Path) -> None:
    write_proposals(tmp_path / "proposals")
    with served(tmp_path) as (url, _), opened_page(browser, url, color_scheme="dark") as page:
        page.goto(f"{url}/?annotator=ann")
        shows(page, 0)
        page.focus("#slider-K_i")
        page.keyboard.press("End")
        page.wait_for_selector("#fault:not([hidden])")
        assert "K_p²/8" in page.locator("#fault").inner_text()
        assert page.locator("#edit").is_disabled()
        page.keyboard.press("e")
        assert "lower K_i" in page.locator("#notice").inner_text()
        page.keyboard.press("Escape")
        page.wait_for_selector("#fault", state="hidden")
        page.keyboard.press("g")
        page.wait_for_selector('#agreement:has-text("No pair has a second opinion yet")')
        page.keyboard.press("Enter")  # there is nothing to accept on this tab
        page.keyboard.press("g")
        shows(page, 0)
    assert lines_of(tmp_path) == []


def test_a_killed_server_keeps_what_it_acknowledged_and_the_page_says_so(
    browser: Any, tmp_path: Path
) -> None:
    write_proposals(tmp_path / "proposals")
    with served(tmp_path) as (url, server), opened_page(browser, url) as page:
        page.goto(f"{url}/?annotator=ann")
        shows(page, 0)
        page.keyboard.press("Enter")
        shows(page, 1)
        server.send_signal(signal.SIGKILL)
        server.wait()
        page.keyboard.press("Enter")
        page.wait_for_selector("#notice.bad")
        assert "does not answer" in page.locator("#notice").inner_text()
        with served(tmp_path, port=int(url.rsplit(":", 1)[1])):
            page.keyboard.press("Enter")
            shows(page, 2)
    assert [line["action"] for line in lines_of(tmp_path)] == ["accept", "accept"]


def test_two_annotators_on_one_pair_see_who_was_first(browser: Any, tmp_path: Path) -> None:
    write_proposals(tmp_path / "proposals", 2)  # so few that both look at the same one
    with served(tmp_path) as (url, _), opened_page(browser, url) as ann:
        ann.goto(f"{url}/?annotator=ann")
        shows(ann, 0)
        with opened_page(browser, url) as bob, opened_page(browser, url) as cy:
            bob.goto(f"{url}/?annotator=bob")
            shows(bob, 1)
            cy.goto(f"{url}/?annotator=cy")
            shows(cy, 0)
            ann.keyboard.press("Enter")
            ann.wait_for_selector('#progress:has-text("1 / 2 done")')
            cy.keyboard.press("r")
            cy.wait_for_selector("#notice.bad")
            assert cy.locator("#notice").inner_text().startswith("Ann accepted this pair at")
            shows(cy, 1)
            bob.keyboard.press("Enter")
            bob.wait_for_selector("#done:not([hidden])")
            assert "Every pair has an answer" in bob.locator("#done-title").inner_text()
    assert [(line["annotator"], line["action"]) for line in lines_of(tmp_path)] == [
        ("ann", "accept"),
        ("bob", "accept"),
    ]
