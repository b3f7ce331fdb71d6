"""Which benches there are, and their bars."""

import ast
import importlib
import json
from pathlib import Path

from bench.runner import Bar, Bench

FOLDER = Path(__file__).resolve().parent
BARS = FOLDER / "bars.json"


def described() -> dict[str, str]:
    """Return each file's name, without its ending, and the first line of its docstring."""
    found = {}
    for path in sorted(FOLDER.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assigned = [node.targets[0] for node in tree.body if isinstance(node, ast.Assign)]
        names = {target.id for target in assigned if isinstance(target, ast.Name)}
        if names & {"BENCH", "BENCHES"}:
            name = path.relative_to(FOLDER).with_suffix("").as_posix()
            found[name] = (ast.get_docstring(tree) or "(no docstring)").splitlines()[0]
    return found


def benches_of(name: str) -> dict[str, Bench]:
    """Return the benches of a file, or the one of FILE/BENCH, by their whole names.

    Raises
    ------
    ValueError
        For a name that no bench has.
    """
    file = name if (FOLDER / f"{name}.py").is_file() else name.rpartition("/")[0]
    if not (FOLDER / f"{file}.py").is_file():
        raise ValueError(f"{name!r} is none of {', '.join(described())}")
    module = importlib.import_module(f"bench.{file.replace('/', '.')}")
    several = getattr(module, "BENCHES", None)
    found = {file: module.BENCH} if several is None else {f"{file}/{key}": b for key, b in several.items()}
    if name != file:
        if name not in found:
            raise ValueError(f"{name!r} is none of {', '.join(found)}")
        return {name: found[name]}
    return found


def bars() -> list[Bar]:
    """Return the bars of all benches."""
    return [Bar(**each) for each in json.loads(BARS.read_text(encoding="utf-8"))]
