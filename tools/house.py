"""How much there is to read, in tokens of code, held against ceilings that only fall.

    python tools/house.py            # print the table; exit 1 where a figure is above its ceiling
    python tools/house.py --lower    # write today's figures where they are below the ceilings

Columns, for the package (and each folder of it), for tools and for tests:

- tokens: of code, without comments, docstrings, line ends and indentation;
- fractions: numbers with a part after the point, anywhere in the code;
- over_500, over_1000: functions of more tokens than that;
- packed: statements that give several names values of their own at once, a number among them;
- fmt_skips: places where the formatter was told to look away.

Lines are not counted: packing them makes code harder to read and lowers nothing here.
"""

import argparse
import ast
import io
import json
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = ROOT / "tests" / "architecture" / "ceilings.json"
PARTS = ("scan2albedo", "tools", "tests")
COLUMNS = ("tokens", "fractions", "over_500", "over_1000", "packed", "fmt_skips")
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
_MARKS = ("fmt: " + "skip", "fmt: " + "off")


def figures(root: Path = ROOT) -> dict[str, Counter[str]]:
    """Return the columns of each part, and of the folders of the package by "scan2albedo/FOLDER"."""
    table: dict[str, Counter[str]] = {}
    for part in PARTS:
        table[part] = Counter(dict.fromkeys(COLUMNS, 0))
        for file in sorted((root / part).rglob("*.py")):
            found = measured(file.read_text(encoding="utf-8"))
            table[part].update(found)
            folder = file.relative_to(root).parts[:2]
            if part == PARTS[0] and not folder[1].endswith(".py"):
                table.setdefault("/".join(folder), Counter()).update(found)
    return table


def measured(text: str) -> Counter[str]:
    """Return the columns of a module."""
    tree = ast.parse(text)
    tokens = list(_tokens_of_code(text, tree))
    of_line = Counter(token.start[0] for token in tokens)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = [sum(of_line[line] for line in range(node.lineno, _end(node) + 1)) for node in functions]
    return Counter(
        tokens=len(tokens),
        fractions=sum(map(_is_fraction, tokens)),
        over_500=sum(size > 500 for size in sizes),
        over_1000=sum(size > 1000 for size in sizes),
        packed=sum(map(_is_packed, ast.walk(tree))),
        fmt_skips=sum(map(text.count, _MARKS)),
    )


def risen(table: dict[str, Counter[str]], ceilings: dict[str, dict[str, int]]) -> list[str]:
    """Return a sentence for each figure that is above its ceiling."""
    return [
        f"{part}: {column} {table[part][column]:,}, at most {ceiling:,} allowed"
        for part, columns in ceilings.items()
        for column, ceiling in columns.items()
        if table[part][column] > ceiling
    ]


def unset_options(root: Path = ROOT) -> list[str]:
    """Return the fields of classes named `...Options` that no call in the package sets.

    `ProcessOptions` is left out, whose fields are arguments of `process` and flags of the command line.
    """
    files = sorted((root / PARTS[0]).rglob("*.py"))
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))]
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    passed = {(_name(call.func), keyword.arg) for call in calls for keyword in call.keywords}
    return [
        f"{node.name}.{field.target.id}"
        for node in nodes
        if isinstance(node, ast.ClassDef) and node.name.endswith("Options") and node.name != "ProcessOptions"
        for field in node.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and field.value is not None
        if not {(node.name, field.target.id), ("replace", field.target.id)} & passed
    ]


def _end(node: ast.stmt) -> int:
    return node.end_lineno or node.lineno


def _name(function: ast.expr) -> str:
    return getattr(function, "attr", getattr(function, "id", ""))


def _tokens_of_code(text: str, tree: ast.Module) -> Iterator[tokenize.TokenInfo]:
    documented: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            documented.update(range(node.lineno, _end(node) + 1))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        docstring = token.type == tokenize.STRING and token.start[0] in documented
        if token.type not in _LAYOUT and not docstring:
            yield token


def _is_fraction(token: tokenize.TokenInfo) -> bool:
    if token.type != tokenize.NUMBER:
        return False
    value = ast.literal_eval(token.string)
    return isinstance(value, float) and value % 1 != 0


def _is_packed(node: ast.AST) -> bool:
    if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Tuple):
        return False
    values = node.value.elts if isinstance(node.value, ast.Tuple) else []
    return any(isinstance(value, ast.Constant) and type(value.value) in (int, float) for value in values)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lower", action="store_true", help="lower the ceilings to today's figures")
    arguments = parser.parse_args()
    table = figures()
    ceilings = json.loads(CEILINGS.read_text(encoding="utf-8"))
    rows = [*sorted(table.items()), *((f"ceiling of {part}", row) for part, row in ceilings.items())]
    print(f"{'':26s}" + "".join(f"{column:>10s}" for column in COLUMNS))
    for name, row in rows:
        print(f"{name:26s}" + "".join(f"{row[column]:10d}" for column in COLUMNS))
    if arguments.lower:
        lowered = {
            part: {column: min(table[part][column], ceiling) for column, ceiling in columns.items()}
            for part, columns in ceilings.items()
        }
        CEILINGS.write_text(json.dumps(lowered, indent=2) + "\n", encoding="utf-8")
    faults = risen(table, ceilings)
    for fault in faults:
        print(fault, file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
