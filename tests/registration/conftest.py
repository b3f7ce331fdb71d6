"""Shapes and raw-like scans that the registration tests share."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.poses import assert_near
from worlds.raw_like import raw_like

from scan2albedo import RawScan
from scan2albedo.geometry.rigid import invert_rigid, procrustes, transform_points
from scan2albedo.registration.inputs import Template
from scan2albedo.synthetic.face_shape import person

FACE_PART = 6706


@dataclass(frozen=True)
class PosedScan:
    """A scan whose pose is known."""

    scan: RawScan
    model_from_scan: np.ndarray

    def assert_found(self, registration, degrees, millimetres):
        """The pose of a registration is off by less, in mm at the model's origin."""
        assert_near(registration.model_from_scan, self.model_from_scan, degrees, millimetres)


@pytest.fixture(scope="session")
def template(model):
    return Template.of(model, 0)


@pytest.fixture(scope="session")
def synthetic_scan(model):
    """Make a raw-like scan of a synthetic person, in the model's own correspondence."""

    def make(seed, **options):
        control = person(model, np.random.default_rng(seed))
        subdivision = model.subdivision(2)
        shape = subdivision.matrix @ control
        scan, scan_from_shape = raw_like(shape, subdivision.faces, seed, **options)
        return PosedScan(scan, invert_rigid(scan_from_shape))

    return make


@pytest.fixture(scope="session")
def ict(shared_data):
    """The published shapes: `faces` and one (V, 3) array a shape, in mm."""
    with np.load(shared_data / "ict_faces.npz") as data:
        shapes = {key[6:]: data[key].astype(float) for key in data if key.startswith("shape_")}
        return {"faces": data["faces"].astype(np.int64), "landmarks68": data["landmarks68"], **shapes}


@pytest.fixture(scope="session")
def ict_scan(ict, model):
    """Make a raw-like scan of a published shape; its true pose comes from landmarks of the generic one."""
    inner = ict["landmarks68"][17:]
    generic = ict["generic_neutral"]
    model_from_generic = procrustes(generic[inner], model.landmarks[17:])

    def make(shape, seed, **options):
        vertices = ict[shape]
        model_from_shape = model_from_generic @ procrustes(vertices[:FACE_PART], generic[:FACE_PART])
        scan, scan_from_shape = raw_like(vertices, ict["faces"], seed, **options)
        return PosedScan(scan, model_from_shape @ np.linalg.inv(scan_from_shape))

    return make


@pytest.fixture(scope="session")
def upright(synthetic_scan):
    """A raw-like scan that stands as the model does."""
    example = synthetic_scan(2)
    return replace(example.scan, vertices=transform_points(example.model_from_scan, example.scan.vertices))
