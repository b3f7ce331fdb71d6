"""The page: templates filled, styles and scripts put in, and a policy that forbids everything else."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from scan2albedo.core.version import VERSION
from scan2albedo.errors import needs_extra
from scan2albedo.report.html.batch_section import BatchSection
from scan2albedo.report.html.scan_section import ScanSection

if TYPE_CHECKING:
    from jinja2 import Environment

_SCRIPTS = (
    "elements",
    "viewer_math",
    "viewer_shaders",
    "viewer_gl",
    "viewer_lights",
    "viewer_pointer",
    "viewer",
    "tables",
    "charts",
    "report",
)
"""In the order in which they build on each other."""


@dataclass(frozen=True)
class Page:
    """All that the page shows."""

    title: str
    written: str
    scans: Sequence[ScanSection]
    topologies: Mapping[str, Mapping[str, Any]]
    batch: BatchSection | None = None
    selection: str = ""
    not_shown: Sequence[tuple[str, str]] = ()
    """(name, reason) of scans that were to be shown and could not be read."""


def page_html(page: Page) -> str:
    """Return the page as one HTML document that loads nothing."""
    style, scripts = _static("report.css"), "\n".join(_static(f"{name}.js") for name in _SCRIPTS)
    script = f'\n(() => {{\n"use strict";\n{scripts}}})();\n'
    policy = (
        "default-src 'none'; img-src data:; "
        f"style-src '{_hash(style)}'; script-src '{_hash(script)}'; base-uri 'none'; form-action 'none'"
    )
    template = _environment().get_template("page.html")
    return template.render(page=page, style=style, script=script, policy=policy, version=VERSION)


def data_json(value: Any) -> str:
    """Return JSON that may stand inside a script element: no text in it can end the element.

    >>> print(data_json({"name": "</script>"}))
    {"name":"\\u003c/script\\u003e"}
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


@cache
def _environment() -> Environment:
    with needs_extra("report"):
        from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
        from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("scan2albedo.report.html", "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Data has been escaped for its place, and the package's own files need no escape.
    environment.filters["data_json"] = lambda value: Markup(data_json(value))
    environment.filters["raw"] = lambda text: Markup(text)
    return environment


@cache
def _static(name: str) -> str:
    return (files("scan2albedo.report.html") / "static" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
