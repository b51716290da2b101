"""Searches the built documentation site, opened as files: `search_site.py FOLDER`.

Needs Chromium.
"""

from __future__ import annotations

import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path

from playwright.sync_api import Page, TimeoutError, sync_playwright

#: Pages to search from, words, and a page that must be found.
SEARCHES = (
    ("index.html", "lease", "attaching.html"),
    ("environments/wildfire.html", "autoreset", "environments/moves.html"),
    ("security.html", "PettingZoo", "environments/team.html"),
)


def found(page: Page, words: str) -> list[str]:
    """The pages that the site's search lists."""
    box, results = (
        page.get_by_role("textbox", name="Search"),
        page.locator(".md-search-result__link"),
    )
    box.click()
    # The page ignores what is typed before its index is there.
    for _ in range(30):
        box.fill("")
        box.press_sequentially(words, delay=50)
        with suppress(TimeoutError):
            results.first.wait_for(timeout=2_000, state="attached")
            return [str(link) for link in results.evaluate_all("all => all.map(link => link.href)")]
    raise SystemExit(f"{page.url}: expected pages that have {words!r}, got none in a minute")


def main() -> None:
    """Searches from each page."""
    site = Path(sys.argv[1]).resolve()
    # A root user's browser, as in containers, has no sandbox.
    flags = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=flags, timeout=120_000
        )
        for start, words, expected in SEARCHES:
            page = browser.new_page()
            page.goto((site / start).as_uri())
            pages = {link.partition("#")[0].partition("?")[0] for link in found(page, words)}
            if (site / expected).as_uri() not in pages:
                raise SystemExit(
                    f"{start}: expected {expected} among what has {words!r}, got {pages}"
                )
        browser.close()


if __name__ == "__main__":
    main()
