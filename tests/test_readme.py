"""README and the pages of docs/ say nothing that is not so."""

import dataclasses
import re
import shlex
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench.registry import benches_of

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
COMING: set[str] = set()
"""Pages that may be linked to before they are there."""
ORDER = ["registration", "fitting", "geometry_image", "light_and_albedo", "face_model", "applications"]
ORDER += ["recognition", "eyeglasses", "reflectance", "files"]
"""Python blocks use what those of earlier pages made; other pages come last."""
YOURS = {"out", "site", "scans", "masks", "frames", "fits", "photographs"}
"""Folders of the reader's own."""

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE)


def code_spans(page: Path) -> list[str]:
    prose = re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"`([^`\n]+)`", prose)


def shell_lines(page: Path) -> Iterator[list[str]]:
    """The words of each shell line and of each command named in the text."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            yield shlex.split(line, comments=True)
    for span in code_spans(page):
        if re.match(r"scan2albedo \S|python tools/", span):
            yield shlex.split(span)


@cache
def root() -> Any:
    import typer

    from scan2albedo.cli.commands import app

    return typer.main.get_command(app)


def is_group(command: Any) -> bool:
    return hasattr(command, "commands")


def command_of(words: list[str]) -> tuple[Any, list[str]]:
    """The command that a line calls and the words after its name."""
    command, rest = root(), words
    while is_group(command) and rest:
        assert rest[0] in command.commands, f"{' '.join(words)}: {rest[0]!r} is not a command"
        command, rest = command.commands[rest[0]], rest[1:]
    return command, rest


def options_in(words: list[str]) -> list[str]:
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
    def names(command: Any, path: str) -> Iterator[str]:
        if is_group(command):
            for name, inner in command.commands.items():
                yield from names(inner, f"{path} {name}")
        else:
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
def python_files(folder: str) -> tuple[Path, ...]:
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


def anchors(page: Path) -> set[str]:
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
        if file.name in COMING and file.parent == DOCS and not file.is_file():
            continue
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


PLACES = {
    "albedo": ["EstimateOptions"],
    "applications": ["RelightOptions", "SwapOptions", "TransferOptions"],
    "eyeglasses": [
        "CanonicalizationOptions",
        "FaceRegistrationOptions",
        "LensPictureOptions",
    ],
    "fitting": ["FitOptions"],
    "recognition": ["TemplateOptions"],
    "reflectance": ["OlatOptions", "ReflectanceFitOptions"],
    "registration": ["RegistrationOptions"],
}
"""Where the options that pages name are."""
BARE = {"registration": "RegistrationOptions", "fitting": "FitOptions", "light_and_albedo": "EstimateOptions"}
BARE["recognition"] = "TemplateOptions"
"""Whose options a page's table lists before it names a class."""


def option_classes() -> dict[str, type]:
    return {
        name: getattr(import_module(f"scan2albedo.{place}"), name)
        for place, names in PLACES.items()
        for name in names
    }


def named_defaults(page: Path, classes: dict[str, type]) -> Iterator[tuple[str, list[object], str]]:
    """Each row of a page's tables of options: what it names, their defaults, and what it says they are."""
    owner = BARE.get(page.stem)
    for row in re.findall(r"^\| (`.*) \|$", text_of(page), re.MULTILINE):
        first, said = row.split(" | ")[:2]
        values = []
        for named, option in re.findall(
            r"`(?:(\w+Options)?\.)?(\w+)(?:=[^`]*)?`", first.partition(", file key")[0]
        ):
            owner = named or owner
            fields = (
                {} if owner is None else {field.name: field for field in dataclasses.fields(classes[owner])}
            )
            assert not named or option in fields, f"{named} has no {option}"
            if option in fields:
                values.append(fields[option].default)
        if values:
            yield first, values, said


def test_defaults_in_tables_are_those_of_the_options():
    classes = option_classes()
    checked = 0
    for page in PAGES:
        for first, defaults, said in named_defaults(page, classes):
            if re.search(r"command|in `|by evidence|broad|objective", said + first):
                continue
            checked += 1
            numbers = [float(number) for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", repr(defaults))]
            told = [
                float(number) for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", said.replace(",0", "0"))
            ]
            if numbers:
                assert told[: len(numbers)] == pytest.approx(numbers), first
            else:
                assert all(str(default).lower() in said.lower() for default in defaults), first
    assert checked > 35


@every_page
def test_tables_have_as_many_cells_in_each_row(page):
    prose = re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    for table in re.findall(r"(?:^\|.*\n)+", prose, re.MULTILINE):
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


@pytest.mark.slow
def test_python_examples_run(tmp_path, monkeypatch):
    """Every Python block of every page, with a synthetic scan in place of the reader's."""
    import trimesh

    from scan2albedo.synthetic import raw_scan, wearer

    scan, _ = raw_scan(0)
    height, width = scan.texture_linear.shape[:2]
    uv = np.zeros((len(scan.vertices), 2))
    uv[scan.faces] = scan.uv
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    color = np.round(255 * scan.texture_linear[row, column] ** (1 / 2.2)).astype(np.uint8)
    mesh = trimesh.Trimesh(scan.vertices, scan.faces, vertex_colors=color, process=False)
    mesh.export(tmp_path / "subject.ply")
    monkeypatch.chdir(tmp_path)
    worn = wearer(0)
    frame = worn.glasses
    names = {
        "meshes": [(frame.rest_vertices, frame.faces), (frame.vertices, frame.faces)],
        "keypoints": [frame.rest_keypoints, frame.keypoints],
        "labels": worn.labels,
        "masks": worn.masks,
        "cameras": worn.cameras,
    }
    for page in in_order():
        for block in blocks(page, "python"):
            exec(compile(block.replace("subject.obj", "subject.ply"), page.name, "exec"), names)
    assert names["albedo"].shape == (512, 512, 3)
    assert names["albedos"].shape[1:] == (512, 512, 3)
    assert names["relit"].shape == (512, 512, 3)
    assert names["landmarks"].shape == (68, 3)
    assert names["carried"].template_vertices.shape == names["vertices"].shape
    assert names["picture"].shape == (256, 256, 3)
    assert names["between"].albedo_linear.shape == (512, 512, 3)
    assert names["frame"].deviation.shape == (len(frame.vertices),)
    assert names["comparable"][names["face"].image.seen].max(-1).mean() == pytest.approx(1, abs=0.2)
    assert (tmp_path / "out" / "subject" / "overview.png").is_file()


def in_order() -> list[Path]:
    first = [ROOT / "README.md", *(DOCS / f"{name}.md" for name in ORDER)]
    return first + [page for page in PAGES if page not in first]
