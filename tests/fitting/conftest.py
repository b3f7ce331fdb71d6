"""Models and scans that the fit's tests share."""

from dataclasses import dataclass

import numpy as np
import pytest
from helpers.face_mask import mask_surface
from helpers.measures import row_lengths
from worlds.raw_like import raw_like

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.rigid import invert_rigid, procrustes, transform_points


@pytest.fixture(scope="session")
def mask_model():
    """A small model: 400 vertices, its own control mesh."""
    vertices, faces = mask_surface(20)
    return AnnotatedFaceModel.from_mesh(vertices, faces, control_size=400, annotate=False, name="mask")


@pytest.fixture(scope="session")
def mask_scan():
    """A wider mask with a longer nose, finely meshed, in the model's frame."""
    vertices, faces = mask_surface(70, nose_mm=32.0, width_mm=74.0)
    return RawScan(vertices - mask_surface(20)[0].mean(0), faces)


@dataclass(frozen=True)
class IctFaces:
    """Face shapes in dense correspondence, head and neck included, and the model of the generic one."""

    shapes: dict[str, np.ndarray]
    faces: np.ndarray
    inner_vertices: int
    landmarks: np.ndarray
    model: AnnotatedFaceModel

    def scan_of(self, name, model, seed=1, by=slice(17, None)):
        """Return a scan of a shape, its pose by some landmarks, and the errors of all after a fit."""
        scan, scan_from_shape = raw_like(self.shapes[name], self.faces, seed)
        given = self.shapes[name][self.landmarks]

        def errors_mm(fitted):
            truth = transform_points(fitted.model_from_scan @ scan_from_shape, given)
            return row_lengths(fitted.landmarks - truth)

        pose = procrustes(given[by], model.landmarks[by]) @ invert_rigid(scan_from_shape)
        return scan, pose, errors_mm


@pytest.fixture(scope="session")
def ict(shared_data):
    path = shared_data / "ict_faces.npz"
    if not path.exists():
        pytest.skip("ict_faces.npz is not among the real scans")
    data = np.load(path)
    shapes = {k.removeprefix("shape_"): data[k].astype(float) for k in data if k.startswith("shape_")}
    generic, faces = shapes["generic_neutral"], data["faces"].astype(np.int64)
    face_area = faces[: int(data["face_area_faces"])]
    landmarks = data["landmarks68"].astype(np.int64)
    model = AnnotatedFaceModel.from_mesh(generic, face_area, landmarks=landmarks, name="generic face")
    return IctFaces(shapes, faces, int(data["narrow_face_vertices"]), landmarks, model)
