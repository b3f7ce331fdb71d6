"""What fits make of the photographs of `unknown_faces`, beside the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from worlds.unknown_faces import (
    BLUR_PX,
    SIZE,
    UnknownFace,
    UnknownPhotograph,
    landmarks_of,
    photographed,
    seen_albedo,
)

from scan2albedo.albedo import albedo_error
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.reflectance import (
    FaceFit,
    ImageFit,
    MorphableReflectanceModel,
    PhotographFiles,
    VertexReflectance,
    fit_face,
    fit_image,
    observe_photograph,
)
from scan2albedo.reflectance.capture_files import FacePhotographFile
from scan2albedo.runs.reflectance.image_run import LANDMARK_NORMALS, shaped_vertices
from scan2albedo.runs.reflectance.model_run import FaceModels


@dataclass(frozen=True)
class JudgedFace:
    """Errors of the mean face, the fit alone and what `fit_face` chose, and of the first and last relit."""

    photograph: UnknownPhotograph
    model: MorphableReflectanceModel
    plain: ImageFit
    fit: FaceFit
    albedo: tuple[float, float, float]
    relit: tuple[float, float]
    seconds: tuple[float, float]
    """CPU seconds of the fit alone, and of `fit_face`."""

    def __str__(self) -> str:
        mean, fit, chosen, *relit = (100 * value for value in (*self.albedo, *self.relit))
        steps = ", ".join(one.step for one in self.fit.evidence if one.accepted) or "mean face"
        row = f"{self.photograph.face.name:44}{mean:10.1f}{fit:8.1f}{chosen:8.1f}"
        left = 100 * self.fit.fit.relative_rmse
        return f"{row}{relit[0]:12.1f}{relit[1]:8.1f}{left:8.1f}  {steps}"


def judged(face: UnknownFace, models: FaceModels, folder: str | None, landmarks: bool = False) -> JudgedFace:
    """Fit a photograph, with the mesh fitted to the true shape or with landmarks, and compare."""
    model, normal_error = models.model, 0.0
    taken = photographed(face, model.diffuse.mean, None if folder is None else Path(folder))
    if landmarks:
        content = {"image": "-", "camera": taken.camera.tolist(), "landmarks": [None] * 68}
        given = FacePhotographFile.model_validate(content)
        marks = landmarks_of(face)
        photograph = PhotographFiles(
            Path("-"), given, taken.image, taken.skin, taken.camera, None, None, marks
        )
        vertices, _, _ = shaped_vertices(photograph, models)
        normal_error = LANDMARK_NORMALS
        truth = seen_albedo(face, model.diffuse.mean, vertices)
        taken = replace(taken, vertices=vertices, faces=models.mean.faces, albedo=truth)
    image = observe_photograph(taken.image, taken.camera, taken.vertices, taken.faces, mask=taken.skin)
    transfer = image.transfer
    assert transfer is not None
    start = time.process_time()
    plain = fit_image(image, model)
    between = time.process_time()
    fit = fit_face(image, model, taken.vertices, taken.faces, normal_error=normal_error)
    seconds = between - start, time.process_time() - between
    mean = model.reconstruct(np.zeros(model.components)).reflectance
    counted = np.asarray(image.seen) & model.known & np.isfinite(taken.albedo[:, 0])

    def albedo(reflectance: VertexReflectance) -> float:
        return albedo_error(reflectance.diffuse_linear, taken.albedo, counted).relative_rmse

    other = _looked_up(taken.relit, taken.camera, taken.vertices)

    def relit(reflectance: VertexReflectance) -> float:
        made = transfer.shade(reflectance, taken.relit_light).radiance_linear
        return albedo_error(made, other, counted).relative_rmse

    chosen = fit.reflectance
    errors = albedo(mean), albedo(plain.face.reflectance), albedo(chosen)
    return JudgedFace(taken, model, plain, fit, errors, (relit(mean), relit(chosen)), seconds)


def _looked_up(picture: FloatArray, camera: FloatArray, vertices: FloatArray) -> FloatArray:
    """Return colours (V, 3) of vertices in a picture (H, W, 3)."""
    pixels, _ = project(camera, vertices)
    smooth = gaussian_filter(picture, (BLUR_PX, BLUR_PX, 0))
    rows = [map_coordinates(smooth[..., c], pixels.T[::-1], order=1, mode="nearest") for c in range(3)]
    return np.stack(rows, axis=1)


def sheet(found: list[JudgedFace]) -> NDArray[np.uint8]:
    """Return a row for each face: photograph, true albedo, mean face, fit alone, what was chosen."""
    rows = []
    for one in found:
        taken, mean = one.photograph, one.model.diffuse.mean
        pixels, depth = project(taken.camera, taken.vertices)
        raster = rasterize(pixels, -depth, taken.faces, (SIZE, SIZE))
        row = [taken.image]
        for albedo in (
            taken.albedo,
            mean,
            one.plain.face.reflectance.diffuse_linear,
            one.fit.reflectance.diffuse_linear,
        ):
            known = np.isfinite(taken.albedo).all(1)
            scale = np.sum(albedo[known] * taken.albedo[known]) / np.sum(albedo[known] ** 2)
            shown = interpolate(raster, taken.faces, np.nan_to_num(scale * albedo))
            row.append(encode_srgb_bytes(np.where(raster.face[..., None] >= 0, np.clip(shown, 0, 1), 0.0)))
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)
