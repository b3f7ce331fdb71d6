"""Every public function and class documents its parameters, results and errors, as numpydoc has it.

Read from the source, without importing it, which takes a second instead of several.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "scan2albedo"
TITLES = ("Parameters", "Returns", "Yields", "Raises", "Warns", "Notes", "References", "Examples")
RETURNING = ("Return", "Give", "Yield")
"""A first line that begins so says what is returned."""
DESCRIBED_IN_TEXT = 2
"""Functions and methods of no more parameters may describe them in their text, by name."""
Function = ast.FunctionDef


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_file(name: str) -> Path:
    path = PACKAGE.parent.joinpath(*name.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def exported(init: Path) -> set[str]:
    """The names of `__all__`; none where a package has none."""
    for node in parsed(init).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


def homes(init: Path) -> dict[str, str]:
    """The module that each name of a package is imported from."""
    found = {}
    for node in ast.walk(parsed(init)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("scan2albedo"):
            found.update({alias.name: node.module for alias in node.names})
    return found


def definition(name: str, module: str) -> tuple[str, ast.stmt] | None:
    """Where a name is defined, and its definition; None for constants and modules."""
    file = module_file(module)
    # The last one, for overloads come first.
    for node in reversed(parsed(file).body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return f"{module}.{name}", node
    onward = homes(file).get(name)
    return None if onward in (None, module) else definition(name, onward)


def public() -> dict[str, ast.stmt]:
    """Definitions of all exported functions and classes, each once."""
    found = {}
    for init in sorted(PACKAGE.rglob("__init__.py")):
        imported = homes(init)
        for name in exported(init):
            if name in imported and (where := definition(name, imported[name])):
                found[where[0]] = where[1]
    return found


PUBLIC = public()
FUNCTIONS = {name: node for name, node in PUBLIC.items() if isinstance(node, Function)}
CLASSES = {name: node for name, node in PUBLIC.items() if isinstance(node, ast.ClassDef)}


def docstring(node: ast.AST) -> str:
    return ast.get_docstring(node) or ""  # type: ignore[arg-type]


def section(text: str, title: str) -> str | None:
    """The body of a docstring's section; None without it."""
    parts = re.split(rf"^({'|'.join(TITLES)})\n-+$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True)).get(title)


def documented_parameters(text: str) -> set[str]:
    """Names at the margin of the section Parameters."""
    names: set[str] = set()
    for line in (section(text, "Parameters") or "").partition(">>>")[0].splitlines():
        if re.match(r"[\w*]", line):
            names |= {name.strip("* ") for name in line.partition(" : ")[0].split(",")}
    return names


def parameters(function: Function) -> set[str]:
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    every += [extra for extra in (given.vararg, given.kwarg) if extra is not None]
    return {argument.arg for argument in every} - {"self", "cls"}


def raised(function: Function) -> set[str]:
    """Names of the errors that stand in the function itself."""
    called = [
        node.exc.func
        for node in ast.walk(function)
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)
    ]
    return {name.id for name in called if isinstance(name, ast.Name) and not name.id.startswith("_")}


def returns_something(function: Function) -> bool:
    annotation = function.returns
    return annotation is not None and not (isinstance(annotation, ast.Constant) and annotation.value is None)


def is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)


def fields(node: ast.ClassDef) -> Iterator[tuple[str, bool]]:
    """Names of a dataclass's public fields, and whether a string below documents each."""
    following = [*node.body[1:], None]
    for line, after in zip(node.body, following, strict=True):
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name) and line.target.id[0] != "_":
            documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            yield line.target.id, documented


def methods() -> Iterator[tuple[str, Function]]:
    """Public methods of exported classes."""
    for name, node in CLASSES.items():
        for line in node.body:
            if isinstance(line, Function) and not line.name.startswith("_"):
                yield f"{name}.{line.name}", line


def lacks_of_function(function: Function) -> Iterator[str]:
    """What a function's docstring lacks, or documents without need."""
    text = docstring(function)
    documented = documented_parameters(text)
    if len(parameters(function)) > DESCRIBED_IN_TEXT or documented:
        yield from sorted(parameters(function) - documented)
    else:
        yield from sorted(name for name in parameters(function) if not re.search(rf"\b{name}\b", text))
    yield from (f"no parameter {name}" for name in sorted(documented - parameters(function)))
    if returns_something(function) and not text.startswith(RETURNING) and section(text, "Returns") is None:
        yield "section Returns"
    yield from (f"raises {error}" for error in raised(function) if error not in text)


def lacks_of_dataclass(node: ast.ClassDef) -> Iterator[str]:
    """The same of a dataclass's fields; a string below a field may name those above it in backticks."""
    strings = [
        line.value.value
        for line in node.body
        if isinstance(line, ast.Expr)
        and isinstance(line.value, ast.Constant)
        and isinstance(line.value.value, str)
    ]
    named = documented_parameters(docstring(node)) | set(re.findall(r"`(\w+)`", " ".join(strings)))
    yield from (field for field, documented in fields(node) if not documented and field not in named)
    yield from documented_parameters(docstring(node)) - {field for field, _ in fields(node)}


def lacks_of_method(method: Function) -> Iterator[str]:
    """The same of a method."""
    text = docstring(method)
    if not text:
        yield "docstring"
    if len(parameters(method)) > DESCRIBED_IN_TEXT:
        yield from sorted(parameters(method) ^ documented_parameters(text))
    yield from (f"raises {error}" for error in raised(method) if error not in text)


def test_what_is_public_was_found():
    assert len(FUNCTIONS) > 100
    assert len(CLASSES) > 80
    assert "scan2albedo.albedo.estimate.estimate_albedo" in FUNCTIONS
    assert {"scan2albedo.pipeline.process.process", "scan2albedo.registration.register.register"} <= set(
        FUNCTIONS
    )


def test_the_first_line_is_a_sentence():
    first = {name: docstring(node).partition("\n\n")[0].rstrip() for name, node in PUBLIC.items()}
    assert not {name: line for name, line in first.items() if not line.endswith((".", ":", "`"))}


def test_functions_document_parameters_returns_and_errors():
    lacks = {name: list(lacks_of_function(node)) for name, node in FUNCTIONS.items()}
    assert not {name: lack for name, lack in lacks.items() if lack}


def test_dataclasses_document_their_fields():
    lacks = {name: list(lacks_of_dataclass(node)) for name, node in CLASSES.items() if is_dataclass(node)}
    assert not {name: lack for name, lack in lacks.items() if lack}


def test_methods_document_many_parameters_and_all_errors():
    lacks = {name: list(lacks_of_method(node)) for name, node in methods()}
    assert not {name: lack for name, lack in lacks.items() if lack}


def test_the_check_sees_what_lacks():
    function = ast.parse(
        'def f(a, *, b):\n    """Do.\n\n    Parameters\n    ----------\n    a : int\n    c : int\n    """\n'
        "    raise ValueError(a)"
    ).body[0]
    assert isinstance(function, Function)
    assert list(lacks_of_function(function)) == ["b", "no parameter c", "raises ValueError"]
