"""Look at a report in headless Chromium: screenshots, wide and narrow, light and dark; and what went wrong.

    python tools/check_report.py OUT [-o FOLDER]

OUT is what `scan2albedo report` takes, or a page that it wrote. Prints the size of the page and everything
that the browser complains about; the exit status is 1 when it complains, or when the page asks for anything
beside itself.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from devtools import Browser

WIDE, NARROW = (1400, 1000), (400, 860)
AWAKE = (
    "[...scan2albedo.viewers.values()]"
    ".every(v => !v.seen || v.painter || v.root.classList.contains('failed'))"
)


def pictures(page: Path, folder: Path) -> list[str]:
    """Write the screenshots of a page into a folder and return what the browser complains about."""
    with Browser() as browser:
        for name, size, dark in (
            ("wide_light", WIDE, False),
            ("wide_dark", WIDE, True),
            ("narrow_light", NARROW, False),
            ("narrow_dark", NARROW, True),
        ):
            browser.look(*size, dark=dark, phone=size is NARROW)
            browser.open(page)
            browser.run("new Promise(done => setTimeout(done, 300))")
            browser.wait(AWAKE)
            browser.screenshot(folder / f"{name}.png")
            wider = browser.run("document.documentElement.scrollWidth - innerWidth")
            if wider > 0:
                browser.messages.append(f"{name}: the page is {wider} px wider than the window")
            if browser.run("Boolean(document.querySelector('details.scan'))"):
                _open_first(browser, folder / f"{name}_scan.png")
            browser.run("scrollTo(0, 0)")
            browser.screenshot(folder / f"{name}_whole.png", whole=True)
        others = [
            url
            for url in browser.requests
            if not url.startswith(("data:", "about:", page.resolve().as_uri()))
        ]
        return [*browser.messages, *(f"asked for {url}" for url in others)]


def _open_first(browser: Browser, path: Path) -> None:
    """Open the first scan of a batch and picture it."""
    browser.run("location.hash = document.querySelector('details.scan').id")
    browser.run("new Promise(done => setTimeout(done, 600))")
    browser.wait(AWAKE)
    browser.screenshot(path)


def main() -> int:
    """Make the pictures and print what is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path, help="Folder of results, or a report")
    parser.add_argument("-o", "--folder", type=Path, default=Path("report_pictures"))
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        page = arguments.out
        if page.is_dir():
            from scan2albedo.report.html import write_report

            page = write_report(arguments.out, Path(scratch) / "report.html").path
        print(f"{page.stat().st_size / 1e6:.2f} MB")
        complaints = pictures(page, arguments.folder)
    for complaint in complaints:
        print(complaint)
    print(f"pictures in {arguments.folder}; {len(complaints)} complaints")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
