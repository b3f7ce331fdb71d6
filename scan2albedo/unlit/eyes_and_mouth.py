"""`eyes_and_mouth`: eyeballs behind a face's lids and the inside of its mouth, as meshes of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import FloatArray, dots
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import lengths, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.io.glb import GlbPart
from scan2albedo.unlit.eyes import (
    LID_LANDMARKS,
    LID_MM,
    LID_SD_MM,
    EyeOpening,
    eyeball_mesh,
    mean_eye_white,
)
from scan2albedo.unlit.face_features import texels_of_parts
from scan2albedo.unlit.mouth import mouth_parts
from scan2albedo.unlit.processed_face import REACH_MM, Eyeball, EyesAndMouth, ProcessedFace

if TYPE_CHECKING:
    from scan2albedo.fitting import FittedFace
    from scan2albedo.unlit.template_baking import TemplateTexture

_GAZE_SD_MM = 0.36
"""Deviation of one eye's gaze from the other's, at the surface of an eyeball."""
_IRIS_SD_MM = 0.4
"""Deviation of an iris that was found."""
_FILM_MM = 2.0
"""How far a scan's surface between the lids lies above the eyeball at most."""
_SKIN_MM = -6.0
"""How far inside an opening skin counts as."""


def eyes_and_mouth(face: ProcessedFace) -> EyesAndMouth:
    """Return eyeballs, where the lids are open, and the inside of the mouth of a processed face.

    An eye is the outline of its lids and the circle of its iris [1]_, found as the likeliest ones under
    priors from the landmarks and from what is known of eyes. Three explanations of both eyes compete: the
    texture shows eyes, the scan has holes between open lids, or the lids are shut. A mouth is seen in place
    of what the scan does not show between open lips. Teeth are usual ones.

    Parameters
    ----------
    face : ProcessedFace
        With landmarks and an albedo; without them there are no parts.

    References
    ----------
    .. [1] A. Yuille, P. Hallinan, D. Cohen, "Feature extraction from faces using deformable templates",
       International Journal of Computer Vision 8(2), 1992.
    """
    require_type(face, ProcessedFace, "eyes_and_mouth: face", "load_result(folder) returns one")
    landmarks, cut_mm = face.landmarks, np.full(face.mask.shape, _SKIN_MM)
    if landmarks is None or not face.has_albedo:
        why = "the face has no landmarks" if landmarks is None else "there is no albedo"
        return EyesAndMouth((), (), cut_mm, np.full((2, 2), np.nan), f"eyes and mouth are left out: {why}")
    openings = {side: EyeOpening.of(face, landmarks[lids]) for side, lids in LID_LANDMARKS.items()}
    odds = np.array([one.odds for one in openings.values()])
    hole = int(np.argmax(np.maximum(odds, 0.0).sum(0)))
    shown = {side: one for side, one in openings.items() if one.odds[hole] > 0}
    if hole and len(shown) > 1:  # lids around holes are as high as each other
        right, left = (one.outlines[hole] for one in shown.values())
        right[[4, 6]] = left[[4, 6]] = (right[[4, 6]] + left[[4, 6]]) / 2
    eyes = _eyeballs(shown, hole) if shown else []
    for eye in eyes:
        one = shown[eye.side]
        cut_mm[one.rows, one.columns] = np.maximum(_inside_mm(one, hole, eye), _SKIN_MM)
    seen = "as the texture shows it" if not hole else "which the scan left out: brown, looking ahead"
    reason = (
        f"{'both eyes' if len(eyes) == 2 else 'one eye'}, {seen}" if eyes else "the eyes are shut or unseen"
    )
    skin_level = np.mean([one.skin[0, 0] for one in openings.values()])
    white = eyes[0].rings_linear[-1] if eyes else mean_eye_white(skin_level)
    parts = [eyeball_mesh(eye) for eye in eyes] + mouth_parts(face, landmarks, white)
    cut_mm[texels_of_parts(face, ["between_lips"]) & ~face.image.seen] = 1
    return EyesAndMouth(tuple(eyes), tuple(parts), np.where(face.mask, cut_mm, _SKIN_MM), odds, reason)


def _eyeballs(shown: Mapping[str, EyeOpening], hole: int) -> list[Eyeball]:
    """Return the eyeballs behind openings, by their side: both are alike and look the same way.

    What an iris lies beside its place is in part the eyeball's, in part its own gaze's, in part an error.
    Eyes that a scan left out (`hole` 1) look ahead.
    """
    globes = {side: one.globe(hole) for side, one in shown.items()}
    radius = float(np.mean([globe[3] for globe in globes.values()]))
    iris_mm = min(float(np.mean([one.outlines[hole][10] for one in shown.values()])), radius / 2 + 1)
    off = {side: one.outlines[hole][8:10] - globes[side][:2] for side, one in shown.items()}
    both = np.mean(list(off.values()), axis=0)
    variance = np.square([LID_SD_MM, _GAZE_SD_MM, _IRIS_SD_MM])
    moved, turned, _ = variance / variance.sum() * (not hole)
    rings = np.mean([one.rings(hole, iris_mm) for one in shown.values()], axis=0)
    eyes = []
    for side, one in shown.items():
        center = globes[side][:3] + [*moved * (off[side] - both), 0]
        aim = ((not hole) * both + turned * (off[side] - both)) / radius
        gaze = np.array([*aim, math.sqrt(1 - min(float(aim @ aim), 1.0))])
        eyes.append(Eyeball(side, one.middle + center, radius, iris_mm, gaze, not hole, rings))
    return eyes


def _inside_mm(opening: EyeOpening, hole: int, eye: Eyeball) -> FloatArray:
    """Return how far (N,) the texels around an eye are inside of the opening before its eyeball."""
    inside = opening.inside_mm(hole)
    # Not where the skin stands far before the eyeball: a corner of the eye is the scan's.
    from_center = opening.place - (eye.center_mm - opening.middle)
    off_axis = np.hypot(*from_center[:, :2].T)
    behind = np.sqrt(np.maximum(eye.radius_mm**2 - off_axis**2, 0.0))
    inside[2] = np.minimum(_FILM_MM - (from_center[:, 2] - behind), eye.radius_mm - off_axis)
    return inside.min(0)


def on_template(
    inside: EyesAndMouth, fitted: FittedFace, gain: float, made: TemplateTexture
) -> TemplateTexture:
    """Return a baked mesh of a fitted face with eyes and mouth behind its openings, but those it has itself.

    Parameters
    ----------
    inside : EyesAndMouth
    fitted : FittedFace
        Whose surface carries the chart of `inside`.
    gain : float
        Of the mesh's colours to those of `inside`.
    made : TemplateTexture
        In the frame of the fitted face.
    """
    parts, places, cut_mm = list[GlbPart](), made.vertices, np.full(len(made.vertices), _SKIN_MM)
    outward = vertex_normals(places, made.faces)
    for part in inside.parts:
        # An eyeball of a template's own is round behind, too; a mouth of its own lies where ours would.
        middle, half = np.mean(part.vertices, axis=0), np.ptp(part.vertices, axis=0) / 2
        away = places - middle
        own = (np.abs(away) < half).all(1) & (away[:, 2] < 0)
        if part.name.startswith("eye"):
            own = (np.abs(lengths(away) - half[0]) < LID_MM) & (away[:, 2] < -half[2] / 2)
            own &= dots(outward, away) > 0
        if not own.any():
            parts.append(replace(part, color_linear=gain * np.asarray(part.color_linear)))
    if len(parts) == len(inside.parts):
        hits = surface_query(fitted.vertices, fitted.faces).query(places)
        pixels = pixels_from_uv(hits.interpolated(fitted.uv, fitted.faces), inside.cut_mm.shape)
        near = hits.distance < REACH_MM
        cut_mm[near] = bilinear(inside.cut_mm[..., None], pixels[near])[:, 0]
    nearest = None if fitted.landmarks is None else cKDTree(places).query(fitted.landmarks)[1]
    return replace(made, parts=tuple(parts), cut_mm=cut_mm, landmarks=nearest)
