"""Look at a report in headless Chromium: screenshots, wide and narrow, light and dark; and what went wrong.

    python tools/check_report.py OUT [-o FOLDER]

OUT is what `scan2albedo report` takes, or a page that it wrote. Prints the size of the page, how bright the
first face is under each preset of light and on which side (presets.png), and everything that the browser
complains about; the exit status is 1 when it complains, or when the page asks for anything beside itself.
"""

import argparse
import base64
import sys
import tempfile
from pathlib import Path

import numpy as np
from devtools import Browser
from PIL import Image

WIDE, NARROW = (1400, 1000), (400, 860)
_SIZE = 320
"""Pixels on a side of the face under each preset."""
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
            if name == "wide_light":
                _presets(browser, folder / "presets.png")
            browser.run("scrollTo(0, 0)")
            browser.screenshot(folder / f"{name}_whole.png", whole=True)
        others = [
            url
            for url in browser.requests
            if not url.startswith(("data:", "about:", page.resolve().as_uri()))
        ]
        return [*browser.messages, *(f"asked for {url}" for url in others)]


def _presets(browser: Browser, path: Path) -> None:
    """Click each preset of the first viewer, print how bright its face is, and picture them side by side."""
    viewer = "[...scan2albedo.viewers.values()].find(v => v.painter)"
    if not browser.run(f"Boolean({viewer})"):
        print("no viewer is awake, so no preset is looked at")
        return
    pictures = []
    buttons = f"[...{viewer}.root.querySelectorAll('.presets button')]"
    for k, label in enumerate(browser.run(f"{buttons}.map(b => b.textContent)")):
        browser.run(f"{buttons}[{k}].click()")
        drawn = browser.run(
            f"(() => {{ let text = ''; for (const byte of {viewer}.pixels({_SIZE})) "
            "text += String.fromCharCode(byte); return btoa(text); })()"
        )
        pixels = np.frombuffer(base64.b64decode(drawn), np.uint8).reshape(_SIZE, _SIZE, 4)[::-1]
        face, brightest = pixels[..., 3] == 255, pixels[..., :3].max(-1)
        halves = [
            np.mean(brightest[:, half][face[:, half]])
            for half in (slice(_SIZE // 2), slice(_SIZE // 2, None))
        ]
        print(
            f"{label}: {np.mean(brightest[face]):.0f} of 255; left half of the picture {halves[0]:.0f}, "
            f"right half {halves[1]:.0f}"
        )
        pictures.append(np.where(face[..., None], pixels[..., :3], np.uint8(255)))
    Image.fromarray(np.hstack(pictures)).save(path)
    browser.run(f"{buttons}[0].click()")


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
            from scan2albedo.report import write_report

            page = write_report(arguments.out, Path(scratch) / "report.html").path
        print(f"{page.stat().st_size / 1e6:.2f} MB")
        complaints = pictures(page, arguments.folder)
    for complaint in complaints:
        print(complaint)
    print(f"pictures in {arguments.folder}; {len(complaints)} complaints")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
