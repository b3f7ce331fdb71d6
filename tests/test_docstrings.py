"""Every public function and class documents its parameters, results and errors, as numpydoc has it."""

import ast
import inspect
import re
from importlib import import_module
from pkgutil import walk_packages
from textwrap import dedent

import pytest

import scan2albedo

TITLES = ("Parameters", "Returns", "Yields", "Raises", "Warns", "Notes", "References", "Examples")
RETURNING = ("Return", "Give", "Yield")
"""A first line that begins so says what is returned."""
DESCRIBED_IN_TEXT = 2
"""Functions and methods of no more parameters may describe them in their text, by name."""


def public():
    """Return the definitions of all exported functions and classes, each once, by where they are."""
    inner = walk_packages(scan2albedo.__path__, "scan2albedo.")
    packages = [scan2albedo, *(import_module(found.name) for found in inner if found.ispkg)]
    exported = [getattr(package, name) for package in packages for name in getattr(package, "__all__", ())]
    return {
        f"{one.__module__}.{one.__name__}": ast.parse(dedent(inspect.getsource(one))).body[0]
        for one in exported
        if inspect.isclass(one) or inspect.isroutine(one)
    }


PUBLIC = public()
FUNCTIONS = {name: node for name, node in PUBLIC.items() if isinstance(node, ast.FunctionDef)}
CLASSES = {name: node for name, node in PUBLIC.items() if isinstance(node, ast.ClassDef)}


def docstring(node):
    return ast.get_docstring(node) or ""


def section(text, title):
    """Return the body of a docstring's section; None without it."""
    parts = re.split(rf"^({'|'.join(TITLES)})\n-+$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True)).get(title)


def documented_parameters(text):
    """Return the names at the margin of the section Parameters."""
    names = set()
    for line in (section(text, "Parameters") or "").partition(">>>")[0].splitlines():
        if re.match(r"[\w*]", line):
            names |= {name.strip("* ") for name in line.partition(" : ")[0].split(",")}
    return names


def parameters(function):
    return {given.arg for given in ast.walk(function.args) if isinstance(given, ast.arg)} - {"self", "cls"}


def unnamed_errors(function):
    """Yield the errors that stand in the function itself, and that its docstring does not name."""
    for node in ast.walk(function):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            error = ast.unparse(node.exc.func)
            if re.match(r"[^\W_]\w*$", error) and error not in docstring(function):
                yield f"raises {error}"


def lacks_of_function(function):
    """Yield what a function's docstring lacks, or documents without need."""
    text = docstring(function)
    documented = documented_parameters(text)
    if len(parameters(function)) > DESCRIBED_IN_TEXT or documented:
        yield from sorted(parameters(function) - documented)
    else:
        yield from sorted(name for name in parameters(function) if not re.search(rf"\b{name}\b", text))
    yield from (f"no parameter {name}" for name in sorted(documented - parameters(function)))
    returns = function.returns is not None and ast.unparse(function.returns) != "None"
    if returns and not text.startswith(RETURNING) and section(text, "Returns") is None:
        yield "section Returns"
    yield from unnamed_errors(function)


def lacks_of_class(node):
    """Yield what a dataclass's docstring lacks, or documents without need.

    A string below a field documents it, and what it names in backticks.
    """
    if not any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
        return
    documented = documented_parameters(docstring(node))
    named, fields, above = set(documented), set(), None
    for line in node.body:
        if isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant):
            named |= {above, *re.findall(r"`(\w+)`", line.value.value)}
        above = ast.unparse(line.target) if isinstance(line, ast.AnnAssign) else None
        fields |= {above} - {None}
        if above and ast.unparse(line.value or line.target).startswith("option("):  # has its help
            named.add(above)
    yield from sorted(field for field in fields - named if field[0] != "_")
    yield from sorted(f"no field {name}" for name in documented - fields)


def methods():
    """Return the public methods of exported classes."""
    return {
        f"{name}.{line.name}": line
        for name, node in CLASSES.items()
        for line in node.body
        if isinstance(line, ast.FunctionDef) and not line.name.startswith("_")
    }


def lacks_of_method(method):
    """Yield what the docstring of a method lacks, or documents without need."""
    text = docstring(method)
    if len(parameters(method)) > DESCRIBED_IN_TEXT:
        yield from sorted(parameters(method) ^ documented_parameters(text))
    yield from unnamed_errors(method)


def lacks_of_first_line(node):
    """Yield the first line of a docstring that is no sentence."""
    first = docstring(node).partition("\n\n")[0].rstrip()
    if not first.endswith((".", ":", "`")):
        yield first


def test_what_is_public_was_found():
    assert len(FUNCTIONS) > 100
    assert len(CLASSES) > 80
    for name in (
        "albedo.estimate.estimate_albedo",
        "pipeline.process.process",
        "registration.register.register",
    ):
        assert f"scan2albedo.{name}" in FUNCTIONS


@pytest.mark.parametrize(
    ("lacks_of", "nodes"),
    [
        (lacks_of_first_line, PUBLIC),
        (lacks_of_function, FUNCTIONS),
        (lacks_of_class, CLASSES),
        (lacks_of_method, methods()),
    ],
)
def test_docstrings_lack_nothing(lacks_of, nodes):
    lacks = {name: list(lacks_of(node)) for name, node in nodes.items()}
    assert not {name: lack for name, lack in lacks.items() if lack}


def test_the_check_sees_what_lacks():
    function = ast.parse(
        'def f(a, *, b):\n    """Do.\n\n    Parameters\n    ----------\n    a : int\n    c : int\n    """\n'
        "    raise ValueError(a)"
    ).body[0]
    assert list(lacks_of_function(function)) == ["b", "no parameter c", "raises ValueError"]
