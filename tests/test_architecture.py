"""The house stays in order: stages do not import each other, and importing the package is light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import scan2albedo

PACKAGE = Path(scan2albedo.__file__).parent
STAGES = ("registration", "fitting", "geometry_image", "albedo", "eyeglasses", "recognition", "reflectance")
GROUND = ("errors", "core", "optimization", "geometry", "io", "face_model", "lighting")
HEAVY = ("open3d", "igl", "embreex", "matplotlib", "cv2", "trimesh", "numba", "xatlas", "scipy", "pyrtools")


def imported_modules(path: Path) -> set[str]:
    """Second part of every scan2albedo import in a file: 'geometry' for scan2albedo.geometry.mesh."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
    return {name.split(".")[1] for name in names if name.startswith("scan2albedo.")}


@pytest.mark.parametrize("stage", STAGES)
def test_stages_stand_on_shared_ground_only(stage):
    for path in (PACKAGE / stage).rglob("*.py"):
        if "app" in path.parts:
            continue
        above = imported_modules(path) - set(GROUND) - {stage}
        assert not above, f"{path.name} imports {sorted(above)}"


@pytest.mark.parametrize("floor", GROUND)
def test_shared_ground_does_not_know_the_stages(floor):
    target = PACKAGE / floor
    for path in target.rglob("*.py") if target.is_dir() else [target.with_suffix(".py")]:
        above = imported_modules(path) & {
            *STAGES,
            "pipeline",
            "applications",
            "cli",
            "synthetic",
            "report",
        }
        if path == PACKAGE / "face_model" / "model.py":
            above -= {"applications"}  # `from_mesh` is a name users know; it only passes on
        assert not above, f"{path.name} imports {sorted(above)}"


def test_benchmarks_are_for_the_command_line_and_the_tools():
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] != "benchmarks" and path.name != "benchmark.py":
            assert "benchmarks" not in imported_modules(path), path


def test_benchmarks_stand_beside_the_command_line():
    for path in (PACKAGE / "benchmarks").rglob("*.py"):
        above = imported_modules(path) & {"cli", "report"}
        assert not above, f"{path.name} imports {sorted(above)}"


def test_applications_join_stages_and_know_no_command_line():
    for path in (PACKAGE / "applications").rglob("*.py"):
        above = imported_modules(path) & {"cli", "report"}
        assert not above, f"{path.name} imports {sorted(above)}"


def test_the_synthetic_renderer_shares_no_shading_code_with_the_estimator():
    for path in (PACKAGE / "synthetic").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for forbidden in (
            "lighting.brdf",
            "lighting.asrm",
            "lighting.shadow_map",
            "lighting.kernels",
            "geometry.rays",
        ):
            assert forbidden not in text, f"{path.name} uses {forbidden}"


def test_import_loads_no_heavy_library():
    code = f"import sys, scan2albedo; print([m for m in {HEAVY!r} if m in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == "[]"


def test_every_public_name_can_be_loaded():
    for name in scan2albedo.__all__:
        assert getattr(scan2albedo, name) is not None


def test_geometry_image_stays_a_function_after_its_package_is_loaded():
    import scan2albedo.geometry_image

    assert callable(scan2albedo.geometry_image)
