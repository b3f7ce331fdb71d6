"""A page as html.parser sees it, with what must hold for each."""

import base64
import hashlib
from html.parser import HTMLParser

from scan2albedo.report import write_report

VOID = {"meta", "img", "input", "br", "link"}
SELF_CLOSED = {"line", "rect", "circle", "polyline"}


class Page(HTMLParser):
    """Elements, text and the raw content of styles and scripts; a fault for every tag that is not closed."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.elements, self.faults, self.raw, self.text = [], [], [], []
        self._open = []
        self.feed(html)
        self.close()
        self.faults += [f"{tag} is not closed" for tag in self._open]

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.elements.append((tag, given))
        if len(given) != len(attributes):
            self.faults.append(f"{tag} has an attribute twice: {attributes}")
        if tag not in VOID:
            self._open.append(tag)
        if tag in ("script", "style"):
            self.raw.append([tag, given, ""])

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in SELF_CLOSED:
            self.faults.append(f"{tag} closes itself")

    def handle_endtag(self, tag):
        if self._open[-1:] == [tag]:
            self._open.pop()
        else:
            self.faults.append(f"{tag} ends inside {self._open[-3:]}")

    def handle_data(self, data):
        if self._open and self._open[-1] in ("script", "style"):
            self.raw[-1][2] += data
        else:
            self.text.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    def words(self):
        return " ".join(" ".join(self.text).split())

    def links(self):
        return [a["href"] for a in self.all("a") if "href" in a]


def check(made):
    """Return the page of a report after proving what must hold for each."""
    html = made.path.read_text(encoding="utf-8")
    assert made.size_bytes == made.path.stat().st_size
    assert html.startswith("<!DOCTYPE html>")
    page = Page(html)
    assert page.faults == []
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    for _, attributes in page.elements:
        assert attributes.get("aria-labelledby", ids[0]) in ids
        assert not [name for name in attributes if name.startswith("on") or name == "style"]
        assert attributes.get("src", "data:").startswith("data:")
    for href in page.links():
        assert ":" not in href
        assert href[0] != "#" or href[1:] in ids
    assert not page.all("link")
    (policy,) = (
        meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"
    )
    for tag, attributes, content in page.raw:
        if attributes.get("type") != "application/json":
            digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
            assert f"{tag}-src 'sha256-{digest}'" in policy
            assert "http" not in content.replace("http://www.w3.org/2000/svg", "")
    assert "default-src 'none'" in policy
    return page


def written(folder, *path):
    """Return the page of the report of a folder, written there or elsewhere, as `check` does."""
    return check(write_report(folder, *path))
