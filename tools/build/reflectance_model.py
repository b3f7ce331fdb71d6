"""Build the reflectance model that comes with the package, of 200 synthetic people.

It is what `scan2albedo reflectance build --synthetic 200` makes, in 0.7 instead of 17 MB: directions are
rounded to a 127th of the largest number among them, and shapes are stored at the control points of the face
model. Everything in it comes from the generator in `scan2albedo.synthetic`. Takes 20 s of CPU.
"""

import numpy as np
from numpy.typing import NDArray

from build import output
from scan2albedo import AnnotatedFaceModel
from scan2albedo.io.npz import write_npz
from scan2albedo.reflectance import LinearModel
from scan2albedo.runs.reflectance.model_run import FaceModels, synthetic_model

PEOPLE = 200


def packed(built: FaceModels) -> dict[str, NDArray]:
    """Return the arrays of the file that `default_model` reads."""
    model, shape = built.model, built.shape
    assert shape is not None
    assert model.known.all()
    to_surface = AnnotatedFaceModel.default().subdivision(1).matrix.toarray()
    surface = np.concatenate([shape.mean[None], shape.basis])
    columns = np.moveaxis(surface, 1, 0).reshape(len(shape.mean), -1)
    found = np.linalg.lstsq(to_surface, columns)[0].reshape(-1, *surface.shape[::2])
    control = np.moveaxis(found, 1, 0)
    parts = {
        "diffuse": model.diffuse,
        "total": LinearModel(model.mean[:, 3], model.basis[..., 3]),
        "share": LinearModel(model.mean[:, 4:6], model.basis[..., 4:6]),
        "shape": LinearModel(control[0], control[1:]),
    }
    arrays = {
        "people": np.array(model.samples),
        "total_variance": np.array(model.total_variance),
        "identity_components": np.array(shape.identity_components),
        "landmark_vertices": shape.landmark_vertices,
    }
    for name, part in parts.items():
        step = np.abs(part.basis).max() / 127
        arrays |= {
            f"{name}_mean": part.mean.astype(np.float32),
            f"{name}_basis": np.round(part.basis / step).astype(np.int8),
            f"{name}_step": step,
        }
    return arrays


def main(arguments: list[str]) -> None:
    file = output(arguments, "reflectance/data/synthetic_people.npz")
    write_npz(file, packed(synthetic_model(PEOPLE)), what="reflectance model", compression=9)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")
