"""A measured face as a template."""

import numpy as np
import pytest


@pytest.fixture
def generic_face(shared_data):
    """Return a function: vertices, faces of a part, landmarks as vertices."""
    data = np.load(shared_data / "ict_faces.npz")

    def of(part):
        faces = data["faces"].astype(np.int64)
        if part != "whole head":
            faces = faces[: int(data["face_area_faces"])]
        if part == "inner face":
            faces = faces[(faces < data["narrow_face_vertices"]).all(1)]
        return data["shape_generic_neutral"].astype(float), faces, data["landmarks68"].astype(np.int64)

    return of
