"""Synthetic people as processed faces, and the files of a processed one."""

import pytest
from helpers.fits import fit_of
from helpers.processed_faces import processed_person

import scan2albedo as s2a
from scan2albedo.core import Trace
from scan2albedo.pipeline.process import write_result
from scan2albedo.pipeline.result import ProcessResult


@pytest.fixture(scope="session")
def person():
    """Make the truth of a scene as if it had been estimated: (seed, expression, size) -> ProcessedFace."""
    return processed_person


@pytest.fixture(scope="session")
def two_people():
    """Two persons at rest."""
    return processed_person(0), processed_person(1)


@pytest.fixture(scope="session")
def result(model):
    """A result whose scan is the model itself, coloured."""
    fitted = fit_of(model, model.control_vertices)
    color = 0.3 + 0.002 * (fitted.vertices - fitted.vertices.min(0))
    scan = s2a.RawScan(fitted.vertices, fitted.faces, vertex_color_linear=color, name="rest")
    image = s2a.geometry_image(fitted, scan, size=48)
    albedo = s2a.estimate_albedo(image, lights=1, budget=s2a.Budget(evaluations=30))
    options = {"model": model.name}
    return ProcessResult(scan, None, fitted, image, albedo, albedo.plan, Trace(), {}, options, 0)


@pytest.fixture(scope="session")
def stored(result, tmp_path_factory):
    return write_result(result, tmp_path_factory.mktemp("out"))
