"""Tests the search of the built documentation site, without a web server: `search_site.py FOLDER`.

Needs Chromium.
"""

from __future__ import annotations

import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path

from playwright.sync_api import Page, TimeoutError, sync_playwright

#: Searches: the page on which to search, the search words, and a page that must be found.
SEARCHES = (
    ("index.html", "attaching and swapping", "attaching.html"),
    ("environments/wildfire.html", "autoreset", "environments/moves.html"),
    ("security.html", "PettingZoo", "environments/team.html"),
)


def finds(page: Page, words: str, expected: str) -> bool:
    """Returns whether the site's search lists a page."""
    box = page.get_by_role("textbox", name="Search")
    link = page.locator(f".md-search-result__link[href*='{expected}']").first
    box.click()
    # Types the words again and again, because the page ignores input until it has loaded its index.
    for _ in range(15):
        box.fill("")
        box.press_sequentially(words, delay=50)
        with suppress(TimeoutError):
            link.wait_for(timeout=2_000, state="attached")
            return True
    return False


def main() -> None:
    """Runs each search from its page."""
    site = Path(sys.argv[1]).resolve()
    # Chromium cannot use its sandbox as root, for example in containers.
    flags = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=flags, timeout=120_000
        )
        for start, words, expected in SEARCHES:
            page = browser.new_page()
            page.goto((site / start).as_uri())
            if not finds(page, words, expected):
                raise SystemExit(f"{start}: expected {expected} among the pages with {words!r}")
        browser.close()


if __name__ == "__main__":
    main()
