"""The floors of pyproject.toml hold, and no files import each other in a circle."""

import runpy
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
from importlinter.cli import lint_imports

import scan2albedo

ROOT = Path(__file__).resolve().parents[2]


def test_imports_keep_to_the_floors_of_pyproject(capsys):
    status = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert status == 0, capsys.readouterr().out


def test_no_two_files_import_each_other_in_a_circle():
    graph = grimp.build_graph("scan2albedo", cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imports).prepare()  # raises CycleError with the circle


def test_the_picture_shows_the_imports():
    drawn = runpy.run_path(str(Path(__file__).with_name("floors.py")))
    mend = "python tests/architecture/floors.py draws it anew"
    assert drawn["PICTURE"].read_text(encoding="utf-8") == drawn["picture"](), mend


def test_every_public_name_can_be_loaded():
    for name in scan2albedo.__all__:
        assert getattr(scan2albedo, name) is not None


def test_geometry_image_stays_a_function_after_its_package_is_loaded():
    import scan2albedo.sampling

    assert callable(scan2albedo.geometry_image)
