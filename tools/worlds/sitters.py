"""Painted people: synthetic sitters with stubble, a fringe, an open mouth and gloss."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray, IntArray, smoothstep
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import BodyPart, Sitter, sit_down
from scan2albedo.synthetic.textures import landmark_uv, smooth_noise
from worlds.path_tracer import Gloss, Part
from worlds.pictures import bilinear, filled_outline

_HINGE_MM = np.array([0.0, 15.0, -75.0])
"""The jaw turns about the axis through this point along x: just before the ears."""
_CAVITY_MM = 1.6
"""This much of the lips' inner edge on either side becomes the mouth's inside when the jaw opens."""
_CAVITY_DEPTH_MM = 16.0
_CHART_MM = 200.0
_GUM = np.array([0.14, 0.035, 0.03])
_TEETH = np.array([0.62, 0.56, 0.46])


@dataclass(frozen=True, kw_only=True)
class Person:
    """Who sits there.

    `tone` runs from 0, lightest skin, to 1; `mouth_deg` is how far the jaw opens; `stubble` and `fringe` are
    densities, 0 for none; `gloss` names the skin's reflection. `skin` is the scan of an evenly lit head whose
    photographed colours are the face's albedo instead.
    """

    name: str
    seed: int
    tone: float
    expression: Expression = "neutral"
    mouth_deg: float = 0.0
    stubble: float = 0.0
    fringe: float = 0.0
    gloss: Gloss = "skin"
    skin: Path | None = None


@lru_cache
def photographed(head: Path) -> FloatArray:
    """Return (512, 512, 3) the linear colours of a head on the face's chart."""
    texture = s2a.process(head, skip=["albedo"], size=512).geometry_image.texture_linear
    assert texture is not None
    return texture.astype(float)


def seated(person: Person, model: s2a.AnnotatedFaceModel) -> Sitter:
    """Return the person as a sitter whose face is painted by `painted`."""
    sitter = sit_down(person.seed, expression=person.expression, model=model, tone=person.tone)
    return with_open_mouth(sitter, person.mouth_deg) if person.mouth_deg else sitter


def painted(person: Person, sitter: Sitter, uv: FloatArray) -> FloatArray:
    """Return (N, 3) linear albedo of the face at chart coordinates (N, 2)."""
    if person.skin is not None:
        picture = photographed(person.skin)
        place = np.stack([(1 - uv[:, 1]) * len(picture), uv[:, 0] * len(picture)]) - 0.5
        return np.clip(bilinear(picture, place), 0.01, 0.95)
    landmarks = landmark_uv(sitter.model)
    albedo = sitter.face_albedo(uv)
    rng = np.random.default_rng([person.seed, 31])
    if person.stubble:
        albedo = albedo * np.exp(-person.stubble * stubble(uv, landmarks, rng)[:, None] * [1.0, 0.95, 0.85])
    if person.fringe:
        cover = person.fringe * fringe(uv, landmarks, rng)[:, None]
        strands = 0.4 * smooth_noise(_along_strands(uv), (170, 6), rng)[:, None]
        albedo = albedo + (1.3 * sitter.hair_color * np.exp(strands) - albedo) * np.clip(cover, 0, 0.95)
    if person.mouth_deg:
        albedo = _with_mouth(albedo, uv, landmarks)
    return np.clip(albedo, 0.01, 0.95)


def stubble(uv: FloatArray, landmarks: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (N,) darkness of shaven hair on jaw, chin and upper lip, 0 on the lips and the cheeks."""
    u, v = uv.T
    corner_v = landmarks[48, 1]
    # From the corners of the mouth the beard's line rises toward the ears.
    aside = np.maximum(np.abs(u - 0.5) - 0.13, 0)
    line = corner_v + 0.02 + 0.75 * aside
    jaw = smoothstep((line - v) / 0.05 + 0.5) * smoothstep((0.49 - np.abs(u - 0.5)) / 0.05)
    moustache = smoothstep((0.105 - np.abs(u - 0.5)) / 0.05 + 0.5)
    moustache *= smoothstep((landmarks[33, 1] - 0.012 - v) / 0.015) * smoothstep((v - corner_v) / 0.02)
    lips = landmarks[[*range(48, 60)]]
    off_lips = smoothstep(_outside(uv, lips) / 0.008)
    hairs = 0.8 + 0.22 * smooth_noise(uv, (230, 230), rng) + 0.1 * smooth_noise(uv, (14, 14), rng)
    return np.maximum(jaw, 0.9 * moustache) * off_lips * np.clip(hairs, 0.1, 1.6)


def fringe(uv: FloatArray, landmarks: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (N,) cover of strands that hang over one side of the forehead."""
    u, v = uv.T
    brow = landmarks[17:27, 1].max()
    lowest = brow + 0.05 + 0.25 * np.abs(u - 0.25) ** 1.2 + 0.012 * smooth_noise(uv, (26, 4), rng)
    turned = _along_strands(uv)
    strands = smooth_noise(turned, (150, 6), rng) + 0.6 * smooth_noise(turned, (50, 4), rng)
    depth = (v - lowest) / 0.10
    return smoothstep((strands + 4.0 * depth - 1.2) / 1.2) * smoothstep((0.72 - u) / 0.2) * (depth > -0.3)


def _along_strands(uv: FloatArray) -> FloatArray:
    """Return uv (N, 2) turned so that its second axis runs down and a little outward."""
    return uv @ np.array([[0.97, 0.26], [-0.26, 0.97]])


def gloss_map(uv: FloatArray, landmarks: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (N,) 0.2 ... 1: how oily the skin is; most on nose, forehead, chin and cheekbones."""
    forehead = landmarks[[19, 24]].mean(0) + [0, 0.07]
    spots = [(landmarks[30], 0.05), (forehead, 0.11), (landmarks[8] + [0, 0.09], 0.05)]
    spots += [(landmarks[k] + [0.03 * np.sign(k - 41), -0.1], 0.07) for k in (41, 46)]
    oily = sum(np.exp(-np.sum((uv - center) ** 2, 1) / (2 * radius**2)) for center, radius in spots)
    patches = 1 + 0.15 * smooth_noise(uv, (9, 9), rng)
    return np.clip((0.35 + 0.65 * np.minimum(oily, 1)) * patches, 0.2, 1)


def jaw_weight(points: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Return (N,) how far points (N, 3) turn with the jaw: 0 above the mouth, 1 below, a fan beside it."""
    corners = landmarks[[48, 54]]
    middle = corners.mean(0)
    half_width = (corners[1, 0] - corners[0, 0]) / 2 - 2.0
    x, y = points[:, 0] - middle[0], points[:, 1] - _lip_line(points[:, 0], landmarks)
    angle = np.arctan2(y, np.maximum(np.abs(x) - half_width, 1e-6))
    beside = smoothstep(0.5 - angle / np.pi)
    within = smoothstep(0.5 - y / (2 * _CAVITY_MM))
    weight = np.where(np.abs(x) < half_width, within, beside)
    # The neck stays, and so does the back of the head.
    chin = landmarks[8]
    stays = smoothstep((chin[1] - 22 - points[:, 1]) / 45)
    behind = smoothstep((_HINGE_MM[2] + 30 - points[:, 2]) / 40)
    return weight * (1 - stays) * (1 - behind)


def opened(points: FloatArray, landmarks: FloatArray, angle_deg: float) -> FloatArray:
    """Return points (N, 3) with the jaw turned down by an angle, and the lips' inner edges drawn inward."""
    weight, angle = jaw_weight(points, landmarks)[:, None], np.deg2rad(angle_deg)
    y, z = (points - _HINGE_MM)[:, 1:].T
    turned = np.stack(
        [0 * y, y * np.cos(angle) - z * np.sin(angle), y * np.sin(angle) + z * np.cos(angle)], 1
    )
    moved = points + weight * (turned + _HINGE_MM * [0, 1, 1] + points * [1, 0, 0] - points)
    half_width = (landmarks[54, 0] - landmarks[48, 0]) / 2 - 2.0
    off = np.abs(points[:, 1] - _lip_line(points[:, 0], landmarks)) / _CAVITY_MM
    across = np.abs(points[:, 0] - landmarks[[48, 54], 0].mean()) / half_width
    inward = smoothstep((1 - off) / 0.5) * smoothstep((1 - across) / 0.25)
    inward[points[:, 2] < landmarks[48, 2] - 12] = 0
    moved[:, 2] -= _CAVITY_DEPTH_MM * min(1.0, angle_deg / 10) * inward
    return moved


def with_open_mouth(sitter: Sitter, angle_deg: float) -> Sitter:
    """Return the sitter with an open jaw: face, head and landmarks."""
    face, before = sitter.face, sitter.face.landmarks
    vertices = sitter.vertices.copy()
    bare = np.unique(sitter.faces[sitter.part <= BodyPart.HEAD])
    vertices[bare] = opened(vertices[bare], before, angle_deg)
    landmarks = opened(before, before, angle_deg)
    landmarks[61:64] = before[61:64]
    landmarks[65:68] = opened(before[65:68] - [0, 2 * _CAVITY_MM, 0], before, angle_deg)
    count = len(face.vertices)
    on_face = vertices[:count]
    shaped = replace(face, vertices=on_face, normals=vertex_normals(on_face, face.faces), landmarks=landmarks)
    normals = vertex_normals(vertices, sitter.faces)
    moved = np.linalg.norm(vertices - sitter.vertices, axis=1) > 1e-6
    return replace(
        sitter, face=shaped, vertices=vertices, normals=np.where(moved[:, None], normals, sitter.normals)
    )


def _inner_lips(landmarks: FloatArray) -> FloatArray:
    """Return (5, K) the middles between both lips' inner landmarks (68, K)."""
    return (landmarks[60:65] + landmarks[[60, 67, 66, 65, 64]]) / 2


def _lip_line(x: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Return (N,) height of the line between the closed lips at x (N,)."""
    inner = _inner_lips(landmarks)
    ends = np.concatenate([landmarks[[48]], inner, landmarks[[54]]])
    return np.interp(x, ends[:, 0], ends[:, 1])


def _with_mouth(albedo: FloatArray, uv: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Return the albedo with gum and upper teeth on the strip that the open jaw draws inward."""
    inner = _inner_lips(landmarks)
    u, v = uv.T
    off_mm = (v - np.interp(u, inner[:, 0], inner[:, 1])) * _CHART_MM
    inside = smoothstep((_CAVITY_MM - np.abs(off_mm)) / 0.4)
    inside *= smoothstep((inner[-1, 0] - u) / 0.01) * smoothstep((u - inner[0, 0]) / 0.01)
    teeth = smoothstep((0.55 - np.abs(off_mm - 0.75)) / 0.2)[:, None]
    return albedo + (_GUM + teeth * (_TEETH - _GUM) - albedo) * inside[:, None]


def _outside(uv: FloatArray, outline: FloatArray) -> FloatArray:
    """Return (N,) distance to a filled polygon's points (K, 2), made dense by interpolation."""
    return cKDTree(filled_outline(outline, 400, np.linspace(0.1, 1, 10))).query(uv)[0]


def face_part(person: Person, sitter: Sitter, size: int) -> Part:
    """Return the face with albedo and gloss on `size` x `size` texels of its chart."""
    face = sitter.face
    grid = texel_coordinates(size)
    albedo = painted(person, sitter, grid)
    gloss = gloss_map(grid, landmark_uv(sitter.model), np.random.default_rng([person.seed, 32]))
    return Part(
        "face",
        face.vertices,
        sitter.normals[: len(face.vertices)],
        face.faces,
        face.uv * [1, -1] + [0, 1],
        albedo.reshape(size, size, 3).astype(np.float32),
        gloss.reshape(size, size).astype(np.float32),
        person.gloss,
    )


def other_parts(person: Person, sitter: Sitter, *, size: int = 768) -> list[Part]:
    """Return head and neck, hair and clothes; corners are split, as their textures have seams."""
    parts = []
    for name, number in (("head", BodyPart.HEAD), ("hair", BodyPart.HAIR), ("clothes", BodyPart.CLOTHES)):
        chosen = np.flatnonzero(sitter.part == number)
        corners = sitter.faces[chosen].ravel()
        uv = sitter.corner_uv[chosen].reshape(-1, 2)
        low, span = uv.min(0), np.ptp(uv, axis=0)
        grid = low + texel_coordinates(size)[:, ::1] * span
        anyone = np.full(len(grid), chosen[0])
        albedo = albedo_of_part(sitter, anyone, grid).reshape(size, size, 3)
        bsdf: Gloss = person.gloss if number == BodyPart.HEAD else "matte"
        vertices, normals = sitter.vertices[corners], sitter.normals[corners]
        faces = np.arange(len(corners)).reshape(-1, 3)
        flat = (uv - low) / span * [1, -1] + [0, 1]
        parts.append(Part(name, vertices, normals, faces, flat, albedo.astype(np.float32), None, bsdf))
    return parts


def albedo_of_part(sitter: Sitter, face: IntArray, uv: FloatArray) -> FloatArray:
    """Return (N, 3) albedo at texture coordinates (N, 2) of the parts that faces (N,) belong to."""
    flat = replace(sitter, corner_uv=np.repeat(uv[:, None], 3, 1), part=sitter.part[face])
    return flat.albedo_at(np.arange(len(uv)), np.full((len(uv), 3), 1 / 3))
