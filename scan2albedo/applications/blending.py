"""`blend_faces`: a face between two."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.applications.texture_swap import continued_skin
from scan2albedo.core.arrays import ArrayLike, FloatArray, NDArray
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.unlit import face_features
from scan2albedo.unlit.processed_face import ProcessedFace, on_common_chart

_OWN_END = 0.05
"""Closer than this to weight 0 or 1 badly seen texels fade to the face's own: the ends are the faces."""


def blend_faces(
    a: ProcessedFace, b: ProcessedFace, weight: float = 0.5, *, model: AnnotatedSurface | None = None
) -> ProcessedFace:
    """Return the face `weight` of the way from A to B, in shape and skin.

    Positions are blended linearly on the chart that both share; normals follow the new surface. The skins are
    scaled to one colour, the geometric mean of theirs by weight, and then blended linearly: level and tint of
    an albedo depend on the scan's light. Features that lie on texels a little apart are moved onto one
    another first (`skin_match.displacement`). What was not seen is continued as in `swap_texture`; eyes and
    mouths that are open in one face alone are the nearer one's, with a note. Raises
    `ApplicationError` when the faces do not share a chart, or for a weight outside [0, 1].

    Parameters
    ----------
    a, b : ProcessedFace
        Of one model and size.
    weight : float
        In [0, 1]: 0 is A, 1 is B. The lights are those of the nearer one.
    model : AnnotatedFaceModel, optional
        With which the faces were processed; the default model when omitted.
    """
    if not 0 <= weight <= 1:
        raise ApplicationError(f"weight is {weight}, expected from 0 (all {a.name}) to 1 (all {b.name})")
    a, b = on_common_chart(a, b, model=model)
    toward_b = face_features.skin_gains(a, b)
    gains = toward_b**weight, toward_b ** (weight - 1)
    nearer, mask = (a if weight < 0.5 else b), a.mask
    mesh = replace(nearer.mesh, vertices=_between(a.mesh.vertices, b.mesh.vertices, weight))
    position = _between(a.image.position[mask], b.image.position[mask], weight)
    shaped_a, shaped_b = (face.reshaped(mesh, position, face.name) for face in (a, b))
    shaped = shaped_a if nearer is a else shaped_b
    scales = [scale for face in (a, b) if (scale := face.image.specular_scale) is not None]
    image = replace(
        shaped.image,
        normal=normalized(_between(shaped_a.image.normal, shaped_b.image.normal, weight)),
        texture_linear=None,
        texture_valid=a.image.seen & b.image.seen,
        specular_scale=_between(scales[0], scales[-1], weight) if scales else None,
        labels=nearer.image.labels if weight in (0, 1) else None,
    )
    skins, displacement = matched_skins(a, b, weight)
    if weight in (0, 1):
        albedo = gains[round(weight)] * skins[round(weight)]
    else:
        # Features move toward one another, A's by `weight`, so that none is there twice.
        first, second = (gain * filled_from_nearest(s, mask) for s, gain in zip(skins, gains, strict=True))
        first = face_features.warped(first, -weight * displacement)
        albedo = _between(first, face_features.warped(second, (1 - weight) * displacement), weight)
    own, other = (
        replace(face.reflectance, specular_strength=float(gain) * face.reflectance.specular_strength)
        for face, gain in zip((a, b), np.exp(np.log(gains).mean(1)), strict=True)
    )
    return replace(
        shaped,
        name=f"{a.name}+{b.name}",
        image=image,
        albedo_linear=albedo.astype(np.float32),
        reflectance=_blended_reflectance(own, other, weight),
        casts_shadows=a.casts_shadows or b.casts_shadows,
        expected_error=None,
        notes=tuple(
            face_features.UNLIKE.format(name, nearer.name) for name in face_features.unlike_features(a, b)
        ),
    )


def _blended_reflectance(a: Reflectance, b: Reflectance, weight: float) -> Reflectance:
    """Return what lies between two reflectances; the nearer one where their models do not blend."""
    strength = float(_between(a.specular_strength, b.specular_strength, weight))
    if (a.brdf == "minnaert") != (b.brdf == "minnaert"):
        return replace(a if weight < 0.5 else b, specular_strength=strength)
    # The exponent of a face without highlight does not count.
    shiny = weight * b.specular_strength / strength if strength > 0 and 0 < weight < 1 else weight
    exponent = float(a.exponent ** (1 - shiny) * b.exponent**shiny)
    brdf = a.brdf if a.brdf == b.brdf else "oren-nayar"
    return Reflectance(brdf, float(_between(a.roughness, b.roughness, weight)), strength, exponent)


def matched_skins(a: ProcessedFace, b: ProcessedFace, weight: float) -> tuple[list[FloatArray], FloatArray]:
    """Return two faces' albedos (H, W, 3), whole, and by how much (H, W, 2) B's features lie beside A's.

    The faces share a chart. Labels say which texels are one feature in either, see `skin_match.displacement`.
    """
    skins, labels, same = [], [], np.zeros_like(a.mask)
    for face, other, part, wins in ((a, b, weight, weight >= 0.5), (b, a, 1 - weight, weight < 0.5)):
        skin, share = face.albedo_linear.astype(float), min(part / _OWN_END, 1.0)
        if share > 0:
            skin = _between(skin, continued_skin(face, other, wins), share)
        skins.append(skin)
        labels.append(
            [face_features.texels_of_parts(face, parts[:1]) for parts in face_features.FEATURES.values()]
        )
        same |= face_features.taken_features(face, other, wins)[0]
    displacement = face_features.displacement(
        skins[0], skins[1], a.mask & b.mask, list(zip(*labels, strict=True))
    )
    # What one face gives to both lies where it is.
    reach = face_features.AROUND
    free = gaussian_filter(1.0 - face_features.grown(same, reach), reach * max(same.shape))
    return skins, displacement * free[..., None]


def _between(a: ArrayLike, b: ArrayLike, weight: float) -> NDArray:
    return (1 - weight) * np.asarray(a, float) + weight * np.asarray(b, float)
