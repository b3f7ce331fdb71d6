"""`reflectance_of_processed`: a processed scan's skin as a reflectance of its model's vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates

from scan2albedo.applications.files import ProcessedScan, load_result
from scan2albedo.core import PointLight
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.lighting.shading import shade_points
from scan2albedo.unlit.processed_face import NO_MODEL, FaceMesh, ProcessedFace

if TYPE_CHECKING:
    from scan2albedo.reflectance import VertexReflectance


@dataclass(frozen=True)
class FaceReflectance:
    """A processed scan's reflectance, and the mesh whose vertices it belongs to."""

    name: str
    """Of the scan."""
    reflectance: VertexReflectance
    """At the mesh's V vertices; unknown where the scan did not show them."""
    mesh: FaceMesh
    """The model's surface in this face's shape, mm: the same triangles for all scans of one model."""
    model_name: str
    """Of the face model that was fitted."""


def reflectance_of_processed(
    source: str | Path | ProcessedScan | ProcessedFace, *, level: float | None = None
) -> FaceReflectance:
    """Return the reflectance of a processed scan at the vertices of its model's surface.

    A vertex less than half of whose texels were seen is unknown. A rough surface becomes the nearest
    Lambertian one, and the highlight the nearest weights of three lobes, one set for all vertices times the
    annotation's relative strength. The `source` is what `load_result` takes, or what it gave. Albedo and
    highlight are scaled to a `level` of the geometric mean of the albedo's V over the seen texels; not when
    omitted. A scan's albedo is known up to its scale: to compare scans, give one level. Raises
    `ApplicationError` when the scan was processed without a model, nothing of it was seen, or it cannot be
    loaded; `ValueError` when `level` is not above 0.

    Notes
    -----
    A light of intensity E in `relight` is one of pi E here: an estimate's albedo is the radiance of the
    surface, a reflectance's pi times that. The nearest Lambertian albedo is A sum f(n, l, v) (n.l) / sum
    (n.l)^2, over normals that the viewer sees and six lights around it; under a point light vertices differ
    from the relit face by 2 % (matte) to 12 % (a roughness of 0.3 rad).
    """
    from scan2albedo.lighting.environment import distant_directions
    from scan2albedo.reflectance import lobe_weights_of_phong, reflectance_from_albedo

    if level is not None and not (np.isfinite(level) and level > 0):
        raise ValueError(f"level must be above 0, got {level}")
    face = source if isinstance(source, ProcessedFace) else load_result(source)
    if face.model_name == NO_MODEL:
        raise ApplicationError(f"{face.name}: processed without a model; process it with one")
    albedo, known = sampled_at_vertices(face.albedo_linear.astype(float), face)
    if not known.any():
        raise ApplicationError(f"{face.name}: no vertex of its surface was seen; scan it from other sides")
    scale = 1.0 if level is None else level / face.level()
    skin, specular_scale = face.reflectance, face.image.specular_scale
    lobes = lobe_weights_of_phong(skin.specular_strength, skin.exponent)
    gloss = np.ones(face.image.shape) if specular_scale is None else specular_scale.astype(float)
    strength, _ = sampled_at_vertices(gloss[..., None], face)
    lambert_share = 1.0
    if skin.brdf != "lambert":
        # The albedo of the Lambertian surface that is nearest to a rough one of albedo 1.
        normals = distant_directions(2000)
        normals = normals[normals[:, 2] > 0.1]
        matte = replace(skin, specular_strength=0.0)
        product, square = np.zeros(()), np.zeros(())
        for azimuth, elevation in np.radians([(0, 0), (30, 0), (0, 30), (-60, 0), (0, -60), (45, 45)]):
            light = PointLight(float(azimuth), float(elevation))
            lambert = np.maximum(normals @ light.direction, 0)
            # Ambient light, 1 in the estimate's units, is not reflected by roughness.
            rough = shade_points(np.zeros_like(normals), normals, [light], matte).light - 1
            product, square = product + rough @ lambert, square + lambert @ lambert
        lambert_share = float(product / square)
    albedo, weights = scale * lambert_share * albedo, scale * strength * lobes
    reflectance = reflectance_from_albedo(albedo, weights=weights, known=known)
    return FaceReflectance(face.name, reflectance, face.mesh, face.model_name)


def sampled_at_vertices(image: FloatArray, face: ProcessedFace) -> tuple[FloatArray, BoolArray]:
    """Return an image (H, W, C) bilinearly at the vertices, as (V, C), and which of these are known (V,)."""
    at, seen = pixels_from_uv(face.mesh.uv, face.image.shape).T[::-1], face.image.seen
    fields = [face.mask, seen, *np.moveaxis(image * seen[..., None], -1, 0)]
    surface, trusted, *total = (
        map_coordinates(field.astype(float), at, order=1, mode="grid-constant") for field in fields
    )
    known = (trusted > 0) & (2 * trusted >= surface)
    means = np.stack(total, 1) / np.where(known, trusted, 1.0)[:, None]
    return np.where(known[:, None], means, np.nan), known
