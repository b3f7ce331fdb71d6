"""The documentation as a site: it builds strictly, without a network, and shows every public name."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import site_pages

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    ("source", "text", "there"),
    [
        ("README.md", "[a](docs/files.md#one-html-page)", "[a](files.md#one-html-page)"),
        ("README.md", "![a](docs/images/before_after.jpg)", "![a](images/before_after.jpg)"),
        (
            "README.md",
            "[index](docs/README.md), [c](CHANGELOG.md)",
            "[index](all_pages.md), [c](changelog.md)",
        ),
        ("docs/install.md", "[R](../README.md#install)", "[R](index.md#install)"),
        (
            "docs/files.md",
            "[here](#units) [web](https://example.org/a)",
            "[here](#units) [web](https://example.org/a)",
        ),
        ("README.md", "the [licence](LICENSE)", "the licence"),
    ],
)
def test_links_lead_to_pages_of_the_site(source, text, there):
    assert site_pages.with_links_of_site(text, source) == there


def test_names_are_found_where_they_are_defined():
    assert site_pages.home_of("fit", "scan2albedo") == "scan2albedo.fitting.fit.fit"
    assert site_pages.home_of("RawScan", "scan2albedo.core") == "scan2albedo.core.raw_scan.RawScan"
    assert site_pages.home_of("no_such_name", "scan2albedo") is None


def test_a_name_is_shown_once_and_linked_to_from_other_packages():
    shown = {}
    first = site_pages.python_page("scan2albedo", ["fit"], shown)
    second = site_pages.python_page("scan2albedo.fitting", ["fit", "FitOptions"], shown)
    assert "::: scan2albedo.fitting.fit.fit" in first
    assert "[`fit`](scan2albedo.md#scan2albedo.fitting.fit.fit)" in second
    assert "::: scan2albedo.fitting.fit.fit\n" not in second
    assert "::: scan2albedo.fitting.options.FitOptions" in second


@pytest.mark.slow
def test_the_site_is_built_without_a_network(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={
            "PATH": "",
            "NO_MKDOCS_2_WARNING": "1",
            "http_proxy": "http://127.0.0.1:9",
            "https_proxy": "http://127.0.0.1:9",
        },
    )
    assert done.returncode == 0, done.stderr + done.stdout
    pages = {
        path.relative_to(tmp_path).as_posix(): path.read_text("utf-8") for path in tmp_path.rglob("*.html")
    }
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"{page.stem}.html" in pages, page.name
    for name, text in pages.items():
        loaded = re.findall(r'<(?:script|img|link)[^>]*(?:src|href)="(https?:[^"]*)"', text)
        assert not loaded, f"{name} loads {loaded}"
    ids = {one for text in pages.values() for one in re.findall(r'id="(scan2albedo[\w.]*)"', text)}
    named = {
        site_pages.home_of(each, package): (package, each)
        for package, public in site_pages.packages()
        for each in public
        if not each.startswith("_")
    }
    lost = {where for home, where in named.items() if home is not None and home not in ids}
    assert not lost
    assert len(named) > 150
