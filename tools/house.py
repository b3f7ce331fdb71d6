"""How large the package is, package by package, held against ceilings that only fall.

    python tools/house.py            # print the table; exit 1 where a total is above its ceiling
    python tools/house.py --lower    # write today's totals where they are below the ceilings

Columns:

- lines: of all Python files; code: of those the lines that are not comment, docstring or blank;
- modules: files; types: data classes and records;
- constants: names at module level that are set to numbers (in a tuple, a call or a sum too), each name of a
  statement that sets several;
- literals: fractions written inside functions, without 0.5: where a constant that was moved would hide;
- once: private functions of a module that stand once beside their definition;
- options: fields of classes named `...Options`; unset: of those the ones that no call in the package sets,
  `ProcessOptions` left out, whose fields are arguments of `process` and flags of the command line.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = ROOT / "tests" / "architecture" / "ceilings.json"
COLUMNS = ("lines", "code", "modules", "types", "constants", "literals", "once", "options", "unset")
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}


def figures(root: Path = ROOT) -> dict[str, Counter[str]]:
    """Return the columns of each package below ``root / "scan2albedo"``; "." holds the files beside them."""
    files = sorted((root / "scan2albedo").rglob("*.py"))
    texts = {file: file.read_text(encoding="utf-8") for file in files}
    trees = {file: ast.parse(text) for file, text in texts.items()}
    set_somewhere = {pair for tree in trees.values() for pair in _options_set(tree)}
    table: dict[str, Counter[str]] = {}
    for file, tree in trees.items():
        parts = file.relative_to(root / "scan2albedo").parts
        row = table.setdefault(parts[0] if len(parts) > 1 else ".", Counter(dict.fromkeys(COLUMNS, 0)))
        text = texts[file]
        row["lines"] += text.count("\n")
        row["code"] += _code_lines(text, tree)
        row["modules"] += 1
        row["constants"] += sum(map(_numbers_set, tree.body))
        row["literals"] += _fractions(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                row["types"] += _is_data_class(node)
                if node.name.endswith("Options") and node.name != "ProcessOptions":
                    fields = [item.target.id for item in node.body if _is_field(item)]  # type: ignore[attr-defined]
                    row["options"] += len(fields)
                    row["unset"] += sum(
                        not {(node.name, name), ("replace", name)} & set_somewhere for name in fields
                    )
            elif isinstance(node, ast.FunctionDef) and re.match("_[^_]", node.name):
                row["once"] += len(re.findall(rf"\b{node.name}\b", text)) == 2
    return table


def totals(table: dict[str, Counter[str]]) -> dict[str, int]:
    """Return the sum of each column."""
    return {column: sum(row[column] for row in table.values()) for column in COLUMNS}


def risen(found: dict[str, int], ceilings: dict[str, int]) -> list[str]:
    """Return a sentence for each figure that is above its ceiling."""
    return [
        f"{column}: {found[column]}, at most {ceilings[column]} allowed; take out as much as you add"
        for column in ceilings
        if found[column] > ceilings[column]
    ]


def _code_lines(text: str, tree: ast.Module) -> int:
    documented: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            documented.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE and token.string:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code - documented)


def _is_number(node: ast.AST) -> bool:
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def _holds_number(node: ast.AST) -> bool:
    if isinstance(node, ast.Tuple | ast.List):
        return any(map(_holds_number, node.elts))
    if isinstance(node, ast.Call):
        return any(map(_holds_number, node.args))
    if isinstance(node, ast.BinOp):
        return _holds_number(node.left) or _holds_number(node.right)
    return _is_number(node)


def _numbers_set(node: ast.stmt) -> int:
    """Return how many names a statement sets to numbers."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return 0
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    names = len(target.elts) if isinstance(target, ast.Tuple) else 1
    return names if _holds_number(node.value) else 0


def _fractions(tree: ast.Module) -> int:
    bodies = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Lambda)]
    inside = {id(node): node for body in bodies for node in ast.walk(body) if isinstance(node, ast.Constant)}
    return sum(type(node.value) is float and node.value % 0.5 != 0 for node in inside.values())


def _is_data_class(node: ast.ClassDef) -> bool:
    bases = {ast.unparse(base).rpartition(".")[2] for base in node.bases}
    decorated = any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)
    return decorated or any(base.endswith("Record") or base in ("BaseModel", "NamedTuple") for base in bases)


def _is_field(node: ast.stmt) -> bool:
    return isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None


def _options_set(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield (class or "replace", field) of the keyword arguments of every call."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            yield from ((called, keyword.arg) for keyword in node.keywords if keyword.arg)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lower", action="store_true", help="lower the ceilings to today's totals")
    arguments = parser.parse_args()
    table = figures()
    found, ceilings = totals(table), json.loads(CEILINGS.read_text(encoding="utf-8"))
    rows = [*sorted(table.items()), ("total", found), ("ceiling", ceilings)]
    print(f"{'':15s}" + "".join(f"{column:>10s}" for column in COLUMNS))
    for name, row in rows:
        print(f"{name:15s}" + "".join(f"{row[column]:10d}" for column in COLUMNS))
    print(f"{1000 * found['constants'] / found['code']:.1f} constants per 1,000 lines of code")
    if arguments.lower:
        lowered = {column: min(found[column], ceilings[column]) for column in COLUMNS}
        CEILINGS.write_text(json.dumps(lowered, indent=2) + "\n", encoding="utf-8")
    faults = risen(found, ceilings)
    for fault in faults:
        print(fault, file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
