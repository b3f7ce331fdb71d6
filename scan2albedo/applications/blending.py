"""`blend_faces`: a face between two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.processed_face import ProcessedFace, on_common_chart
from scan2albedo.applications.skin_match import displacement, skin_gains, warped
from scan2albedo.applications.texture_swap import continued_skin
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.lighting.shading import Reflectance

_OWN_END = 0.05
"""Closer than this to weight 0 or 1 badly seen texels fade to the face's own: the ends are the faces."""


def blend_faces(
    a: ProcessedFace,
    b: ProcessedFace,
    weight: float = 0.5,
    *,
    model: AnnotatedSurface | None = None,
) -> ProcessedFace:
    """Return the face `weight` of the way from A to B, in shape and skin.

    Positions are blended linearly on the chart that both share; normals follow the new surface. The skins are
    scaled to one colour, the geometric mean of theirs by weight, and then blended linearly: level and tint of
    an albedo depend on the scan's light, and the brighter scan would dominate. Features that lie on texels a
    little apart are moved onto one another first (`skin_match.displacement`), so that none is there twice.
    Where the texture of one face was not seen, for example under hair, the detail of the other is continued
    in its colours, and eyes, brows, nostrils and mouth of which a part was not seen are the other's as a
    whole, as in `swap_texture`; where neither was seen the colour is continued smoothly.

    Parameters
    ----------
    a, b : ProcessedFace
        Of one model and size.
    weight : float
        In [0, 1]: 0 is A, 1 is B. The lights are those of the nearer one.
    model : AnnotatedFaceModel, optional
        With which the faces were processed; the default model when omitted.

    Raises
    ------
    ApplicationError
        When the faces do not share a chart, or for a weight outside [0, 1].
    """
    if not 0 <= weight <= 1:
        raise ApplicationError(
            f"weight is {weight}, expected a number from 0 (all {a.name}) to 1 (all {b.name})"
        )
    a, b = on_common_chart(a, b)
    nearer, gains = (a if weight < 0.5 else b), _gains(a, b, weight)
    levels = (float(np.exp(np.log(gains[0]).mean())), float(np.exp(np.log(gains[1]).mean())))
    mask = a.mask
    vertices = _between(a.mesh.vertices, b.mesh.vertices, weight)
    mesh = replace(nearer.mesh, vertices=vertices)
    position = _between(a.image.position[mask], b.image.position[mask], weight)
    shaped_a, shaped_b = (face.reshaped(mesh, position, face.name) for face in (a, b))
    normal = _between(shaped_a.image.normal, shaped_b.image.normal, weight)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    shaped = shaped_a if nearer is a else shaped_b
    image = replace(
        shaped.image,
        normal=normal / np.where(length > 0, length, 1),
        texture_linear=None,
        texture_valid=a.image.seen & b.image.seen,
        specular_scale=_between_maps(a.image.specular_scale, b.image.specular_scale, weight),
    )
    skins = (
        gains[0] * _whole_skin(a, b, weight, model),
        gains[1] * _whole_skin(b, a, 1 - weight, model),
    )
    albedo = skins[round(weight)] if weight in (0, 1) else _met(*skins, mask, weight)
    return replace(
        shaped,
        name=f"{a.name}+{b.name}",
        image=image,
        albedo_linear=albedo.astype(np.float32),
        reflectance=_blended_reflectance(a.reflectance, b.reflectance, weight, levels),
        casts_shadows=a.casts_shadows or b.casts_shadows,
    )


def _met(a: FloatArray, b: FloatArray, mask: BoolArray, weight: float) -> FloatArray:
    """Return (H, W, 3) the albedo between two whose features move toward one another, A's by `weight`."""
    beside = displacement(a, b, mask)
    first, second = (filled_from_nearest(albedo, mask) for albedo in (a, b))
    return _between(warped(first, -weight * beside), warped(second, (1 - weight) * beside), weight)


def _between(a: NDArray, b: NDArray, weight: float | NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((1 - weight) * a + weight * b, np.float64)


def _whole_skin(
    face: ProcessedFace, other: ProcessedFace, weight: float, model: AnnotatedSurface | None
) -> NDArray[np.float64]:
    """Return (H, W, 3) the albedo, continued where it was badly seen unless `weight` of `other` is low."""
    own = face.albedo_linear.astype(np.float64)
    share = min(weight / _OWN_END, 1.0)
    if share == 0:
        return own
    return _between(own, continued_skin(face, other, model), share)


def _between_maps(a: NDArray | None, b: NDArray | None, weight: float) -> NDArray | None:
    if a is None or b is None:
        return a if b is None else b
    return _between(a, b, weight)


def _gains(a: ProcessedFace, b: ProcessedFace, weight: float) -> tuple[FloatArray, FloatArray]:
    """Return (3,) each: what brings A's and B's skin to the colour between theirs."""
    toward_b = skin_gains(a, b)
    return toward_b**weight, toward_b ** (weight - 1)


def _blended_reflectance(
    a: Reflectance, b: Reflectance, weight: float, gains: tuple[float, float]
) -> Reflectance:
    """Return the reflectance between two; the nearer one's where their models do not blend."""
    strength = (1 - weight) * gains[0] * a.specular_strength + weight * gains[1] * b.specular_strength
    nearer = a if weight < 0.5 else b
    if (a.brdf == "minnaert") != (b.brdf == "minnaert"):
        return replace(nearer, specular_strength=strength)
    if a.brdf == b.brdf == "lambert":
        brdf = "lambert"
    else:
        brdf = "minnaert" if a.brdf == "minnaert" else "oren-nayar"
    exponent = _blended_exponent(a, b, weight)
    return Reflectance(brdf, (1 - weight) * a.roughness + weight * b.roughness, strength, exponent)


def _blended_exponent(a: Reflectance, b: Reflectance, weight: float) -> float:
    """Return the exponent between two; that of a face without highlight does not count."""
    if 0 < weight < 1 and 0 in (a.specular_strength, b.specular_strength):
        return b.exponent if a.specular_strength == 0 else a.exponent
    return float(a.exponent ** (1 - weight) * b.exponent**weight)
