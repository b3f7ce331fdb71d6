"""Synthetic people as processed faces, and the files of a processed one."""

import numpy as np
import pytest
from helpers.processed_faces import person_scene, processed_person

import scan2albedo as s2a
from scan2albedo.core import Trace
from scan2albedo.fitting import FittedFace
from scan2albedo.pipeline.result import ProcessResult, write_result


@pytest.fixture(scope="session")
def scene():
    """Make a synthetic scene: (seed, expression, size) -> SyntheticScene."""
    return person_scene


@pytest.fixture(scope="session")
def person():
    """Make the truth of a scene as if it had been estimated: (seed, expression, size) -> ProcessedFace."""
    return processed_person


@pytest.fixture(scope="session")
def two_people():
    """Two persons at rest."""
    return processed_person(0), processed_person(1)


def _fitted_model():
    """The default model at rest as a fit would return it."""
    model = s2a.AnnotatedFaceModel.default()
    subdivision = model.subdivision(1)
    vertices = subdivision.matrix @ model.control_vertices
    uv = model.refined_uv(1)
    return FittedFace(
        vertices,
        subdivision.faces,
        uv,
        model.region[subdivision.parent],
        np.zeros(len(vertices)),
        np.eye(4),
        1,
        model,
        model.control_vertices,
        model.landmarks,
        None,
        True,
        1,
        Trace(),
    )


@pytest.fixture(scope="session")
def result():
    """A result whose scan is the model itself, coloured."""
    fitted = _fitted_model()
    color = 0.3 + 0.002 * (fitted.vertices - fitted.vertices.min(0))
    scan = s2a.RawScan(fitted.vertices, fitted.faces, vertex_color_linear=color, name="rest")
    image = s2a.geometry_image(fitted, scan, size=48)
    albedo = s2a.estimate_albedo(image, lights=1, budget=s2a.Budget(evaluations=30))
    options = {"model": fitted.model.name}
    return ProcessResult(scan, None, fitted, image, albedo, albedo.plan, Trace(), {}, options, 0)


@pytest.fixture(scope="session")
def stored(result, tmp_path_factory):
    return write_result(result, tmp_path_factory.mktemp("out"))
