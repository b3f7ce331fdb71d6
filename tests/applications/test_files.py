"""Results from files and from memory; what is missing or foreign is named."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.npz import cut
from helpers.processed_faces import person_scene
from helpers.records import files_in, read_json
from numpy.testing import assert_allclose, assert_array_equal

import scan2albedo as s2a
from scan2albedo.albedo import EstimateOptions
from scan2albedo.applications import (
    ProcessedFace,
    RelightOptions,
    TransferOptions,
    load_result,
    relight,
    swap_texture,
    transfer_expression,
    write_face,
)
from scan2albedo.errors import ApplicationError
from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import read_image_linear, write_exr
from scan2albedo.pipeline.process import write_result

LIGHT = s2a.PointLight(0.5, 0.3, intensity=2.0)
AS_ESTIMATED = RelightOptions(gloss="found", fill_gaps=False)


@pytest.fixture
def folder(stored, tmp_path):
    return shutil.copytree(stored, tmp_path / "rest")


def test_files_and_memory_give_the_same_face(result, stored):
    memory, disk = load_result(result), load_result(stored)
    assert_array_equal(memory.image.position, disk.image.position)
    assert_array_equal(memory.mesh.faces, disk.mesh.faces)
    assert_allclose(memory.mesh.vertices, disk.mesh.vertices, atol=1e-9)
    assert_allclose(memory.mesh.uv, disk.mesh.uv, atol=1e-6)
    for name in ("name", "model_name", "casts_shadows", "view_direction", "shadow_offset_mm"):
        assert getattr(memory, name) == getattr(disk, name)
    ours, theirs = (relight(face, [LIGHT]).texture_linear for face in (memory, disk))
    assert_allclose(ours, theirs, rtol=1e-5, atol=1e-8)
    # Relighting is what the estimate does.
    again = relight(memory, [LIGHT], options=AS_ESTIMATED).texture_linear
    assert_allclose(again, result.albedo.relit([LIGHT]), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["result.json", "geometry_image.npz", "albedo.exr", "fitted.glb"])
def test_a_damaged_or_missing_file_is_named(folder, name):
    cut(folder / name)
    with pytest.raises(ApplicationError, match=name):
        load_result(folder)
    (folder / name).unlink()
    with pytest.raises(ApplicationError, match=f"{name}: is missing"):
        load_result(folder)


def test_coloured_light_goes_through_files_and_applications(result, tmp_path):
    lamps = (s2a.PointLight(0.5, 0.3, 800.0, 2.0, (1.4, 1.0, 0.6), 6.0),)
    soft = s2a.EnvironmentLight(np.eye(9, 3) + 0.2, fill=0.25, bounce=0.1)
    estimate = replace(result.albedo, lights=lamps, environment=soft)
    folder = write_result(replace(result, albedo=estimate), tmp_path)
    assert read_image_linear(folder / "shading.exr").shape == (*estimate.image.shape, 3)
    memory, disk = load_result(replace(result, albedo=estimate)), load_result(folder)
    made = write_face(swap_texture(disk, disk), tmp_path / "new", application="swap", inputs=[disk, disk])
    for face in (memory, disk, load_result(made)):
        assert face.environment.fill == 0.25
        assert_array_equal(face.environment.coefficients, soft.coefficients)
        for ours, given in zip(face.lights, lamps, strict=True):
            assert (ours.color_linear, ours.radius_deg) == (given.color_linear, given.radius_deg)
    lit = relight(disk, disk.lights, environment=disk.environment, options=AS_ESTIMATED).texture_linear
    # The lamp of 6 degrees is sampled more finely than the estimate does.
    assert np.abs(lit - estimate.relit(lamps, soft))[disk.mask].mean() < 0.005 * lit[disk.mask].mean()


def test_a_glossy_face_under_its_own_light_is_its_texture():
    image = person_scene(0).image
    # Lamps of a size are sampled more finely than the estimate does; coloured ones have coloured highlights.
    options = EstimateOptions(skip=("albedo.lamp_size", "albedo.light_colour"))
    estimate = s2a.estimate_albedo(image, lights=1, options=options)
    assert estimate.reflectance.specular_strength > 0
    given = ProcessedFace.of(
        "glossy", image, estimate.albedo_linear, reflectance=estimate.reflectance, lights=estimate.lights
    )
    truth, mask = image.texture_linear, image.mask
    ours = relight(given, given.lights, environment=estimate.environment, options=AS_ESTIMATED).texture_linear
    assert_allclose(ours, estimate.relit(estimate.lights, estimate.environment), rtol=1e-4, atol=1e-6)
    # Light that no part of the model stands for is divided out, but not relit.
    assert np.linalg.norm((ours - truth)[mask]) / np.linalg.norm(truth[mask]) < 0.11


def test_files_of_different_runs_are_refused(folder, result):
    fitted = result.fitted
    picture = np.zeros((4, 4, 3), np.uint8)
    write_glb(folder / "fitted.glb", fitted.vertices + 1.0, fitted.faces, fitted.uv, picture)
    with pytest.raises(ApplicationError, match=r"fitted\.glb.*different runs"):
        load_result(folder)
    write_exr(folder / "albedo.exr", np.ones((20, 20, 3)))
    with pytest.raises(ApplicationError, match=r"albedo\.exr.*different runs"):
        load_result(folder)


def test_results_without_albedo_and_folders_of_something_else_are_refused(folder, result, tmp_path):
    record = read_json(folder / "result.json")
    (folder / "result.json").write_text(json.dumps(record | {"parameters": {}}))
    for source, words in (
        (folder, "no albedo"),
        (replace(result, albedo=None), "no albedo"),
        (tmp_path / "nothing", "no such folder"),
        (tmp_path, r"result\.json: is missing"),
    ):
        with pytest.raises(ApplicationError, match=words):
            load_result(source)


def test_spherical_harmonics_relight_as_a_matte_surface(result):
    estimate = s2a.estimate_albedo(result.geometry_image, brdf="spherical-harmonics")
    face = load_result(replace(result, albedo=estimate))
    assert face.reflectance.brdf == "lambert"
    assert np.isfinite(relight(face, [LIGHT]).texture_linear).all()


def test_a_shape_alone_is_taken_where_no_albedo_is_needed(result, tmp_path):
    grey = replace(result, albedo=None)
    folder = write_result(grey, tmp_path)
    memory, disk = (load_result(source, need_albedo=False) for source in (grey, folder))
    assert (memory.has_albedo, disk.has_albedo) == (False, False)
    assert_array_equal(memory.image.position, disk.image.position)
    made = transfer_expression(disk, memory, disk, options=TransferOptions(correspondence="as-fitted"))
    written = write_face(made, tmp_path / "new", application="transfer-expression", inputs=[disk])
    expected = {"application.json", "fitted.glb", "geometry_image.npz", "picture.png"}
    assert files_in(written) == expected
    again = load_result(written, need_albedo=False)
    assert_allclose(again.mesh.vertices, disk.mesh.vertices, atol=0.01)
    assert not again.has_albedo
    for source in (folder, written):
        with pytest.raises(ApplicationError, match="holds no albedo"):
            load_result(source)
