"""Pages of the documentation's site that are not files of docs/: README, CHANGELOG, and Python's names.

`mkdocs.yml` names this module as a hook; `make docs` builds the site.
"""

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "scan2albedo"
HIDDEN = ("cli", "core", "io", "optimization", "report.html", "statistics")
"""Packages whose names the others have, or that are called from the shell alone."""
MOVED = {
    "README.md": "index.md",
    "docs/README.md": "all_pages.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}
"""Pages under another name on the site, since an index there stands for its folder."""

_LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)(#[^)\s]*)?(?=\))")


def on_files(files: Any, config: Any) -> Any:
    """Add README, the index of docs/ and CHANGELOG with links of the site, and a page for each package."""
    from mkdocs.structure.files import File

    files.remove(files.get_file_from_path("README.md"))
    for source, name in MOVED.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=with_links_of_site(text, source)))
    listed = config["nav"][-1]["Python"] = []
    shown: dict[str, str] = {}
    for name, public in packages():
        page = f"python/{name}.md"
        files.append(File.generated(config, page, content=python_page(name, public, shown)))
        listed.append({name: page})
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links of docs/ that leave the folder to the pages that stand for those files."""
    source = f"docs/{page.file.src_uri}"
    return with_links_of_site(markdown, source) if (ROOT / source).is_file() else markdown


def with_links_of_site(text: str, source: str) -> str:
    """Return Markdown of the file `source` of the repository with links as the site has them.

    Links to files that the site does not have become their names.
    """

    def moved(match: re.Match[str]) -> str:
        target = str(PurePosixPath(source).parent / match[1])
        while "/../" in f"/{target}":
            target = re.sub(r"(^|[^/]+/)\.\./", "", target, count=1)
        found = MOVED.get(target, target.removeprefix("docs/"))
        return found + (match[2] or "")

    text = _LINK.sub(moved, text)
    on_site = {path.name for path in (ROOT / "docs").glob("*.md")} | set(MOVED.values())

    def kept(match: re.Match[str]) -> str:
        there = match[2] in on_site or match[2].startswith(("images/", "python/", "http", "#"))
        return match[0] if there else match[1]

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(?:#[^)\s]*)?\)", kept, text)


def packages() -> Iterator[tuple[str, list[str]]]:
    """Yield the names of public packages, each with what its `__all__` names."""
    for init in sorted(PACKAGE.rglob("__init__.py"), key=lambda path: path.parent.as_posix()):
        name = ".".join(init.parent.relative_to(ROOT).parts)
        if name.removeprefix("scan2albedo.") in HIDDEN:
            continue
        if public := getattr(import_module(name), "__all__", None):
            yield name, list(public)


def python_page(name: str, public: list[str], shown: dict[str, str]) -> str:
    """Return the page of a package: its own docstring, then those of what it names.

    `shown` has the page on which a name was shown first; other pages lead there.
    """
    parts = [f"# {name}\n\n::: {name}\n    options:\n      members: false\n"]
    for each in (name for name in public if not name.startswith("_")):
        home = home_of(each, name)
        if home is None:
            continue
        if shown.setdefault(home, name) == name:
            parts.append(f"::: {home}\n    options:\n      show_root_heading: true\n")
        else:
            parts.append(f"- [`{each}`]({shown[home]}.md#{home})\n")
    return "\n".join(parts)


def home_of(name: str, package: str) -> str | None:
    """Return where a public name of a package is defined; None for packages and what is made when asked for.

    Said in full, for many a module has the name of the function in it.
    """
    folder = ROOT.joinpath(*package.split("."))
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    if not file.is_file():
        return None
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return f"{package}.{name}"
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if name in map(ast.unparse, targets):
                return f"{package}.{name}"
        if isinstance(node, ast.ImportFrom) and node.module not in (None, package):
            found = home_of(name, node.module) if name in {alias.name for alias in node.names} else None
            if found:
                return found
    return None
