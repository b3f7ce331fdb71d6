"""The published generic face, whole or in part."""

import numpy as np


def generic_face(folder, part):
    """Return vertices in mm, faces of the "whole head", "face area" or "inner face", and all of its file."""
    data = np.load(folder / "ict_faces.npz")
    vertices, faces = data["shape_generic_neutral"].astype(float), data["faces"].astype(np.int64)
    if part != "whole head":
        faces = faces[: int(data["face_area_faces"])]
    if part == "inner face":
        faces = faces[(faces < int(data["narrow_face_vertices"])).all(1)]
    return vertices, faces, data
