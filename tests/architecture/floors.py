"""Draw the floors of the package from its imports: docs/images/floors.svg.

    python tests/architecture/floors.py

A line leads from a package to each one that it imports; one that it reaches through another as well has
none. `test_floors.py` says when the picture is stale.
"""

import tomllib
from pathlib import Path

import grimp
import networkx

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "floors.svg"
WIDTH = 1080
FLOOR = 66
BOX_WIDTH = 122
BOX_HEIGHT = 28
LINES = '<g fill="none" stroke="#6b5b45" stroke-opacity="0.6">'
BOXES = '<g fill="#f4efe6" stroke="#6b5b45">'
NAMES = '<g fill="#222222" font-family="sans-serif" font-size="14" text-anchor="middle">'


def floors() -> list[list[str]]:
    """Return the names of the packages, floor by floor, the highest first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    layers = next(each["layers"] for each in contracts["contracts"] if each["id"] == "floors")
    return [layer.split(" | ") for layer in layers]


def imports() -> networkx.DiGraph:
    """Return which package imports which, without the imports that follow from others."""
    modules = grimp.build_graph("scan2albedo", cache_dir=None)
    graph = networkx.DiGraph()
    for module in modules.find_descendants("scan2albedo"):
        for imported in modules.find_modules_directly_imported_by(module):
            ends = [_package(module), _package(imported)]
            if all(ends) and ends[0] != ends[1]:
                graph.add_edge(*ends)
    return networkx.transitive_reduction(graph)


def _package(module: str) -> str:
    """Return the package of a module that stands on a floor; nothing for others."""
    name = f"{module}.".split(".")[1]
    return name if any(name in floor for floor in floors()) else ""


def picture() -> str:
    """Return the picture as SVG."""
    places = {
        name: (WIDTH * (column + 0.5) / len(floor), FLOOR * (row + 0.5))
        for row, floor in enumerate(floors())
        for column, name in enumerate(floor)
    }
    height = FLOOR * len(floors())
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">'
    lines = [_line(places[above], places[below]) for above, below in sorted(imports().edges)]
    boxes = [_box(*place) for place in places.values()]
    names = [f'<text x="{x:.0f}" y="{y + 5:.0f}">{name}</text>' for name, (x, y) in places.items()]
    return "\n".join([head, LINES, *lines, "</g>", BOXES, *boxes, "</g>", NAMES, *names, "</g></svg>\n"])


def _line(start: tuple[float, float], end: tuple[float, float]) -> str:
    top = start[1] + BOX_HEIGHT / 2
    bottom = end[1] - BOX_HEIGHT / 2
    middle = (top + bottom) / 2
    curve = f"M{start[0]:.0f},{top:.0f} C{start[0]:.0f},{middle:.0f} {end[0]:.0f},{middle:.0f} "
    return f'<path d="{curve}{end[0]:.0f},{bottom:.0f}"/>'


def _box(x: float, y: float) -> str:
    corner = f'x="{x - BOX_WIDTH / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}"'
    return f'<rect {corner} width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="4"/>'


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
