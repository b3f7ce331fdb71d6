"""A synthetic person in front of the scanner: face, head and neck, hair, clothes, each with its albedo."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.parametrization import boundary_loop
from scan2albedo.synthetic.face_shape import Expression, FaceSurface, face_surface, person, with_relief
from scan2albedo.synthetic.head import hair_shell, head_around, join, shoulder_sheet
from scan2albedo.synthetic.textures import paint_face, skin, smooth_noise

Painter = Callable[[FloatArray], FloatArray]


class BodyPart(IntEnum):
    """Parts of a person."""

    FACE = 0
    HEAD = 1
    HAIR = 2
    CLOTHES = 3


_HAIR_COLORS = np.array(
    [[0.035, 0.024, 0.018], [0.085, 0.050, 0.028], [0.22, 0.14, 0.07], [0.12, 0.045, 0.02]]
)
_CLOTH_COLORS = np.array([[0.62, 0.66, 0.64], [0.08, 0.11, 0.20], [0.30, 0.06, 0.07], [0.20, 0.26, 0.20]])


@dataclass(frozen=True)
class Sitter:
    """A person's surface, part by part, and how to colour any point of it; frame: the model's, mm.

    `control_points` (C, 3) are those of the face without its fine relief. `vertices` and `normals` (V, 3) and
    `faces` (F, 3) hold all parts; `part` (F,) is a `BodyPart`; `corner_uv` (F, 3, 2) are the
    coordinates at which a part's texture is painted, on the face the model's chart. `face_albedo` gives
    linear albedo (N, 3) at chart coordinates (N, 2); `seed` is that of the textures.
    """

    model: AnnotatedSurface
    control_points: FloatArray
    face: FaceSurface
    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    part: IntArray
    corner_uv: FloatArray
    tone: float
    hair_color: FloatArray
    cloth_color: FloatArray
    seed: int
    face_albedo: Painter

    def albedo_at(self, face: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return (N, 3) linear albedo at surface points given by face (N,) and barycentric (N, 3)."""
        uv = np.einsum("nk,nkc->nc", barycentric, self.corner_uv[face])
        part, albedo = self.part[face], np.zeros((len(face), 3))
        of_face, head, hair, clothes = (part == name for name in BodyPart)
        albedo[of_face] = self.face_albedo(uv[of_face])
        albedo[head] = skin(uv[head], np.random.default_rng([self.seed, 3]), tone=self.tone)
        # Hair has strands along v, cloth a weave and folds.
        for at, color, number, low, high, waves in (
            (hair, self.hair_color, 4, 0.004, 0.9, ((0.45, (700, 5)), (0.35, (160, 4)))),
            (clothes, self.cloth_color, 5, 0.01, 0.95, ((0.05, (300, 300)), (0.06, (9, 9)))),
        ):
            rng = np.random.default_rng([self.seed, number])
            (a, cells_a), (b, cells_b) = waves
            pattern = a * smooth_noise(uv[at], cells_a, rng) + b * smooth_noise(uv[at], cells_b, rng)
            albedo[at] = np.clip(color * np.exp(pattern)[:, None], low, high)
        return albedo

    def specular_scale_at(self, face: IntArray) -> FloatArray:
        """Return (N,) relative strength of highlights on faces (N,)."""
        scale = np.array([1.0, 0.8, 0.5, 0.0])[self.part[face]]
        on_face = self.part[face] == BodyPart.FACE
        scale[on_face] = self.model.region_values("specular_scale")[self.face.region[face[on_face]]]
        return scale


def sit_down(
    seed: int,
    *,
    expression: Expression,
    model: AnnotatedSurface,
    expression_strength: float = 1.0,
    tone: float | None = None,
    face_albedo: Painter | None = None,
) -> Sitter:
    """Return a random person, head upright in the model's frame.

    `seed` draws shape and textures. The skin's `tone`, 0 lightest ... 1 darkest, and `face_albedo`, see
    `Sitter`, are random when None.
    """
    rng, of_shape = np.random.default_rng([seed, 6]), np.random.default_rng([seed, 2])
    control_points = person(model, of_shape, expression=expression, expression_strength=expression_strength)
    face = with_relief(face_surface(model, control_points), rng)
    head_vertices, head_faces, head_uv = head_around(face.vertices, face.faces, face.normals)
    bare = join([(face.vertices, face.faces), (head_vertices, head_faces)])
    hair = hair_shell(*bare, rng, thickness_mm=16.0, side_drop_deg=rng.uniform(18, 30), size=(140, 420))
    clothes = shoulder_sheet(face.vertices, rng)
    parts = [(face.vertices, face.faces), (head_vertices, head_faces), hair, clothes]
    vertices, faces = join(parts)
    # Face and head share their normals along the rim.
    normals = vertex_normals(vertices, faces)
    rim = boundary_loop(len(face.vertices), face.faces)
    twin = len(face.vertices) + np.arange(len(rim))
    normals[rim] = normals[twin] = normalized(normals[rim] + normals[twin])
    # Hair around the crown and from it down, so that strands hang; a face across the seam at the back takes
    # its low corners a turn further.
    low, high = hair[0].min(0), hair[0].max(0)
    offset = hair[0] - np.array([(low[0] + high[0]) / 2, 0.0, low[2] + 0.35 * (high[2] - low[2])])
    turn = np.arctan2(offset[:, 0], offset[:, 2]) / (2 * np.pi) + 0.5
    hair_uv = np.stack([turn, (hair[0][:, 1] - low[1]) / (high[1] - low[1])], 1)[hair[1]]
    wide = np.ptp(hair_uv[..., 0], axis=1) > 0.5
    hair_uv[wide, :, 0] += hair_uv[wide, :, 0] < 0.5
    # Clothes from the front, one unit for 200 mm.
    flat = (clothes[0][:, :2] - clothes[0][:, :2].min(0)) / 200
    drawn = float(rng.uniform(0, 0.8))
    skin_tone = drawn if tone is None else tone

    def at_random(uv: FloatArray) -> FloatArray:
        return paint_face(uv, model, np.random.default_rng(seed), tone=skin_tone)

    return Sitter(
        model,
        control_points,
        face,
        vertices,
        faces,
        normals,
        np.repeat(np.arange(4), [len(f) for _, f in parts]),
        np.concatenate([face.corner_uv, head_uv[head_faces], hair_uv, flat[clothes[1]]]),
        tone=skin_tone,
        hair_color=_HAIR_COLORS[rng.integers(len(_HAIR_COLORS))],
        cloth_color=_CLOTH_COLORS[rng.integers(len(_CLOTH_COLORS))],
        seed=seed,
        face_albedo=at_random if face_albedo is None else face_albedo,
    )
