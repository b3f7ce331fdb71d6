"""README and the pages of docs/ say nothing that is not so."""

import dataclasses
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from importlib import import_module
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from bench.registry import benches_of
from helpers.square import vertex_colors

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
ORDER = ["registration", "fitting", "geometry_image", "light_and_albedo", "face_model", "applications"]
ORDER += ["recognition", "eyeglasses", "reflectance", "files"]
"""Python blocks use what those of earlier pages made; other pages come last."""
YOURS = {"out", "site", "scans", "masks", "frames", "fits", "photographs"}
"""Folders of the reader's own."""

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@cache
def text_of(page):
    return page.read_text(encoding="utf-8")


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE)


def prose(page):
    """Return the text of a page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)


def code_spans(page):
    return re.findall(r"`([^`\n]+)`", prose(page))


def shell_lines(page):
    """The words of each shell line and of each command named in the text."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            yield shlex.split(line, comments=True)
    for span in code_spans(page):
        if re.match(r"scan2albedo \S|python tools/", span):
            yield shlex.split(span)


def write_ply(scan, file):
    color = np.round(255 * vertex_colors(scan) ** (1 / 2.2)).astype(np.uint8)
    trimesh.Trimesh(scan.vertices, scan.faces, vertex_colors=color, process=False).export(file)


@cache
def root():
    import typer

    from scan2albedo.cli.commands import app

    return typer.main.get_command(app)


def inner(command):
    """Return the commands of a group by name; of any other none."""
    return getattr(command, "commands", {})


def command_of(words):
    """The command that a line calls and the words after its name."""
    command, rest = root(), words
    while inner(command) and rest:
        assert rest[0] in command.commands, f"{' '.join(words)}: {rest[0]!r} is not a command"
        command, rest = command.commands[rest[0]], rest[1:]
    return command, rest


def options_in(words):
    """Names of the options among words; numbers are none."""
    return [word.partition("=")[0] for word in words if re.match(r"--?[a-zA-Z]", word)]


@every_page
def test_make_targets_exist(page):
    makefile = text_of(ROOT / "Makefile")
    for target in re.findall(r"(?:^|`)make (\w[\w-]*)", text_of(page), re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_readme_names_the_two_make_commands():
    targets = re.findall(r"^make (\w+)", text_of(ROOT / "README.md"), re.MULTILINE)
    assert targets == ["demo", "test"]


def test_readme_is_short():
    assert len(text_of(ROOT / "README.md").split()) <= 1200


def test_continuous_integration_runs_both_test_commands():
    commands = text_of(ROOT / ".ci" / "run").splitlines()
    assert commands[-2:] == ["make test", "make test-slow"]


@every_page
def test_commands_and_their_options_exist(page):
    for words in shell_lines(page):
        if words[:1] != ["scan2albedo"] or words[1:] == ["COMMAND", "--help"]:
            continue
        command, rest = command_of(words[1:])
        known = {name for parameter in command.params for name in parameter.opts + parameter.secondary_opts}
        for option in options_in(rest):
            assert option in known | {"--help"}, f"{' '.join(words)}: there is no {option}"


def test_stage_pages_show_how_to_call_them():
    for name in ORDER[:-1]:
        page = DOCS / f"{name}.md"
        assert any(words[0] == "scan2albedo" for words in shell_lines(page)), name
        assert blocks(page, "python"), name


def test_the_page_of_commands_names_every_command():
    def names(command, path):
        for name, one in inner(command).items():
            yield from names(one, f"{path} {name}")
        if not inner(command):
            yield path

    table = {span for span in code_spans(DOCS / "commands.md") if span.startswith("scan2albedo ")}
    assert set(names(root(), "scan2albedo")) <= table


@every_page
def test_tools_and_their_options_exist(page):
    for words in shell_lines(page):
        if words[:1] != ["python"] or not words[1].startswith("tools/"):
            continue
        tool = ROOT / words[1]
        files = [tool] if tool.is_file() else list(tool.glob("*.py"))
        assert files, words[1]
        for option in options_in(words[2:]):
            assert any(f'"{option}"' in text_of(file) for file in files), f"{words[1]} has no {option}"


@every_page
def test_benches_and_their_methods_exist(page):
    for words in shell_lines(page):
        if words[:2] != ["python", "tools/bench"]:
            continue
        names = list(takewhile(lambda word: not word.startswith("-"), words[2:]))
        found = [bench for name in names if name != "NAME" for bench in benches_of(name).values()]
        if "--methods" in words:
            given = words[words.index("--methods") + 1 :]
            for method in takewhile(lambda word: not word.startswith("-"), given):
                assert any(method in {**bench.methods, **bench.peers} for bench in found), method


@cache
def python_files(folder):
    return tuple((ROOT / folder).rglob("*.py"))


@every_page
def test_named_folders_and_files_exist(page):
    for folder in re.findall(r"`((?:\w+/)*\w+)/`", text_of(page)):
        there = any((base / folder).is_dir() for base in (ROOT / "scan2albedo", ROOT))
        assert there or folder.partition("/")[0] in YOURS, folder
    for script in re.findall(r"`((?:examples|tools|tests|data_schemas)/[\w./]+)`", text_of(page)):
        assert (ROOT / script).exists(), script
    package = {path.name for folder in ("scan2albedo", "tools", "examples") for path in python_files(folder)}
    for module in re.findall(r"`(\w+\.py)`", text_of(page)):
        assert module in package, module


def anchors(page):
    """What links to headings of a page may name, as GitHub makes it."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@every_page
def test_relative_links_and_images_exist(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


BARE = {
    "registration": "RegistrationOptions",
    "fitting": "FitOptions",
    "light_and_albedo": "EstimateOptions",
    "recognition": "TemplateOptions",
}
"""Whose options a page's table lists before it names a class."""
NUMBER = r"\d+(?:\.\d+)?(?:e-?\d+)?"


def default_values():
    """Return the default of each field by the names of the public classes of options."""
    places = ("albedo", "applications", "eyeglasses", "fitting", "recognition", "reflectance", "registration")
    return {
        name: {field.name: field.default for field in dataclasses.fields(getattr(package, name))}
        for package in map(import_module, (f"scan2albedo.{place}" for place in places))
        for name in package.__all__
        if name.endswith("Options")
    }


def named_defaults(page, defaults):
    """Yield each row of a page's tables of options: what it names, their defaults, and what it says."""
    owner = BARE.get(page.stem)
    for row in re.findall(r"^\| (`.*) \|$", text_of(page), re.MULTILINE):
        first, said = row.split(" | ")[:2]
        values = []
        for named, option in re.findall(
            r"`(?:(\w+Options)?\.)?(\w+)(?:=[^`]*)?`", first.partition(", file key")[0]
        ):
            owner = named or owner
            fields = defaults.get(owner, {})
            assert not named or option in fields, f"{named} has no {option}"
            if option in fields:
                values.append(fields[option])
        if values:
            yield first, values, said


def test_defaults_in_tables_are_those_of_the_options():
    every = default_values()
    checked = 0
    for page in PAGES:
        for first, defaults, said in named_defaults(page, every):
            if re.search(r"command|in `|by evidence|broad|objective", said + first):
                continue
            checked += 1
            numbers, told = (
                [float(number) for number in re.findall(NUMBER, text)]
                for text in (repr(defaults), said.replace(",0", "0"))
            )
            if numbers:
                assert told[: len(numbers)] == pytest.approx(numbers), first
            else:
                assert all(str(default).lower() in said.lower() for default in defaults), first
    assert checked > 35


@every_page
def test_tables_have_as_many_cells_in_each_row(page):
    for table in re.findall(r"(?:^\|.*\n)+", prose(page), re.MULTILINE):
        cells = {line.replace("\\|", "").count("|") for line in table.splitlines()}
        assert len(cells) == 1, table.splitlines()[0]


def test_every_page_is_in_the_index():
    for page in DOCS.glob("*.md"):
        assert page.name == "README.md" or f"({page.name})" in text_of(DOCS / "README.md"), page.name


@every_page
def test_python_examples_are_python(page):
    for block in blocks(page, "python"):
        compile(block, page.name, "exec")


def test_the_picture_is_small():
    from PIL import Image

    picture = DOCS / "images" / "before_after.jpg"
    assert picture.stat().st_size <= 150_000
    with Image.open(picture) as opened:
        assert 1100 <= opened.width <= 1300


RECIPES = re.findall(
    r"^### (.*?)\n.*?^```py\n(.*?)^```", text_of(DOCS / "architecture.md"), re.DOTALL | re.MULTILINE
)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [block for _, block in RECIPES], ids=[title for title, _ in RECIPES])
def test_what_is_added_from_outside_runs(recipe, coarse_scan, tmp_path):
    write_ply(coarse_scan[0], tmp_path / "subject.ply")
    assert len(recipe.splitlines()) <= 40
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools")}
    subprocess.run([sys.executable, "-c", recipe], cwd=tmp_path, env=environment, check=True)


@pytest.mark.slow
def test_python_examples_run(tmp_path, monkeypatch):
    """Every Python block of every page, with a synthetic scan in place of the reader's."""
    from scan2albedo.synthetic import raw_scan, wearer

    write_ply(raw_scan(0)[0], tmp_path / "subject.ply")
    monkeypatch.chdir(tmp_path)
    worn = wearer(0)
    frame = worn.glasses
    names = {
        "meshes": [(vertices, frame.faces) for vertices in (frame.rest_vertices, frame.vertices)],
        "keypoints": [frame.rest_keypoints, frame.keypoints],
        "labels": worn.labels,
        "masks": worn.masks,
        "cameras": worn.cameras,
    }
    first = [ROOT / "README.md", *(DOCS / f"{name}.md" for name in ORDER)]
    for page in [*first, *(page for page in PAGES if page not in first)]:
        for block in blocks(page, "python"):
            exec(compile(block.replace("subject.obj", "subject.ply"), page.name, "exec"), names)
    for name in ("albedo", "relit"):
        assert names[name].shape == (512, 512, 3)
    assert names["carried"].template_vertices.shape == names["vertices"].shape
    assert names["comparable"][names["face"].image.seen].max(-1).mean() == pytest.approx(1, abs=0.2)
    assert (tmp_path / "out" / "subject" / "overview.png").is_file()
