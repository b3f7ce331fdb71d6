"""A synthetic person in front of the scanner: face, head and neck, hair, clothes, each with its albedo."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter

from scan2albedo.core.arrays import FloatArray, IntArray, grid_faces, norms, smoothstep
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.mesh import join, normalized, vertex_normals, without_unreferenced
from scan2albedo.geometry.parametrization import boundary_loop
from scan2albedo.synthetic.face_shape import Expression, FaceSurface, face_surface, person, with_relief
from scan2albedo.synthetic.renderer import RayScene
from scan2albedo.synthetic.textures import LOOKS, layers, paint_face, skin

Painter = Callable[[FloatArray], FloatArray]


class BodyPart(IntEnum):
    """Parts of a person."""

    FACE = 0
    HEAD = 1
    HAIR = 2
    CLOTHES = 3


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

    def points_at(self, face: IntArray, barycentric: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and unit normals (N, 3) at surface points given as for `albedo_at`."""
        corners = self.faces[face]
        position = np.einsum("nk,nkc->nc", barycentric, self.vertices[corners])
        return position, normalized(np.einsum("nk,nkc->nc", barycentric, self.normals[corners]))

    def albedo_at(self, face: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return (N, 3) linear albedo at surface points given by face (N,) and barycentric (N, 3)."""
        uv = np.einsum("nk,nkc->nc", barycentric, self.corner_uv[face])
        part, albedo = self.part[face], np.zeros((len(face), 3))
        of_face, head, hair, clothes = (part == name for name in BodyPart)
        albedo[of_face] = self.face_albedo(uv[of_face])
        albedo[head] = skin(uv[head], np.random.default_rng([self.seed, 3]), tone=self.tone)
        # Hair has strands along v, cloth a weave and folds.
        for at, color, number, name in (
            (hair, self.hair_color, 4, "hair"),
            (clothes, self.cloth_color, 5, "cloth"),
        ):
            pattern = layers(uv[at], name, np.random.default_rng([self.seed, number]))
            albedo[at] = np.clip(color * np.exp(pattern)[:, None], *LOOKS[f"{name}_limits"])
        return albedo

    def specular_scale_at(self, face: IntArray) -> FloatArray:
        """Return (N,) relative strength of highlights on faces (N,)."""
        scale = LOOKS["specular_scale"][self.part[face]]
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
    # Clothes from the front, one unit for 200 mm.
    flat = (clothes[0][:, :2] - clothes[0][:, :2].min(0)) / 200
    drawn = float(rng.uniform(0, 0.8))
    skin_tone = drawn if tone is None else tone

    def at_random(uv: FloatArray) -> FloatArray:
        return paint_face(uv, model, np.random.default_rng(seed), tone=skin_tone)

    part = np.repeat(np.arange(4), [len(f) for _, f in parts])
    corner_uv = np.concatenate([face.uv[face.faces], head_uv[head_faces], hair_uv(*hair), flat[clothes[1]]])
    return Sitter(
        *(model, control_points, face, vertices, faces, normals, part, corner_uv),
        tone=skin_tone,
        hair_color=rng.choice(LOOKS["hair_colors"]),
        cloth_color=rng.choice(LOOKS["cloth_colors"]),
        seed=seed,
        face_albedo=at_random if face_albedo is None else face_albedo,
    )


Mesh = tuple[FloatArray, IntArray]

SKULL_CENTER_FROM_NOSE_MM = np.array([0.0, 40.0, -105.0])
HEAD_AXIS_FROM_NOSE_MM = np.array([0.0, 0.0, -100.0])
SKULL_SEMI_AXES_MM = np.array([74.0, 108.0, 105.0])


def nose_tip(vertices: FloatArray) -> FloatArray:
    """Return (3,) the foremost vertex of a face that looks along +z."""
    return vertices[np.argmax(vertices[:, 2])]


def hair_uv(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3, 2) around the crown and from it down, so that strands hang.

    A face across the seam at the back takes its low corners a turn further.
    """
    low, high = vertices.min(0), vertices.max(0)
    offset = vertices - np.array([(low[0] + high[0]) / 2, 0.0, low[2] + 0.35 * (high[2] - low[2])])
    turn = np.arctan2(offset[:, 0], offset[:, 2]) / (2 * np.pi) + 0.5
    uv = np.stack([turn, (vertices[:, 1] - low[1]) / (high[1] - low[1])], 1)[faces]
    wide = np.ptp(uv[..., 0], axis=1) > 0.5
    uv[wide, :, 0] += uv[wide, :, 0] < 0.5
    return uv


def hair_shell(
    vertices: FloatArray,
    faces: IntArray,
    rng: np.random.Generator,
    *,
    thickness_mm: float = 11.0,
    side_drop_deg: float = 0.0,
    size: tuple[int, int] = (90, 220),
) -> Mesh:
    """Return a bumpy cap of hair that hugs a head (or continues a bare face) down to a ragged hairline.

    The head, `vertices` (V, 3) mm and `faces` (F, 3), looks along +z with +y up. `thickness_mm` is that at
    the crown. The hair hangs `side_drop_deg` lower at the sides than a short cut (25 covers the ears). `size`
    counts rows from crown to hairline and columns around.
    """
    center = nose_tip(vertices) + SKULL_CENTER_FROM_NOSE_MM
    rows, columns = size
    # Unit directions (R, C, 3) from the centre of the skull, and the share (R, C) of the way down.
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    fringe = gaussian_filter(rng.normal(size=columns), 1.5, mode="wrap") * 4.0
    side = np.sin(around) ** 2 * np.where(np.cos(around) < 0, 1.0, np.abs(np.sin(around)))
    lowest_deg = 89 - 9 * np.cos(around) + (8 + side_drop_deg) * side + fringe
    share = np.linspace(0, 1, rows)[:, None] * np.ones(columns)
    polar = (np.deg2rad(lowest_deg) * (0.02 + 0.98 * share))[..., None]
    directions = _from_crown(polar, around)
    flat = directions.reshape(-1, 3)
    far = 400.0
    hits = RayScene(vertices, faces).first_hit(center + far * flat, -flat)
    skull = 1 / norms(flat / SKULL_SEMI_AXES_MM)
    surface = np.where(hits.face >= 0, far - hits.distance, 0.0)
    radius = gaussian_filter(np.maximum(skull, surface).reshape(size), (3, 5), mode=("nearest", "wrap"))
    # Strands that run from the crown down, over broader waves, in mm.
    locks = np.zeros(size)
    for amplitude, *sigma in LOOKS["locks"]:
        noise = gaussian_filter(rng.normal(size=size), sigma, mode=("nearest", "wrap"))
        locks += amplitude * noise / noise.std()
    radius += 0.8 + (thickness_mm - 0.8) * np.sqrt(1 - share**2) + locks * (1.2 - share)
    return (center + radius[..., None] * directions).reshape(-1, 3), grid_faces(*size, wrap=True)


def _from_crown(polar: FloatArray, around: FloatArray) -> FloatArray:
    """Return unit directions (R, C, 3) by angles from the crown (R, C, 1) and around it (C,)."""
    right, crown = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.75, -0.66])
    forward = np.cross(right, crown)
    forward *= np.sign(forward[2]) / np.linalg.norm(forward)
    level = np.cos(around)[:, None] * forward + np.sin(around)[:, None] * right
    return np.cos(polar) * (crown / np.linalg.norm(crown)) + np.sin(polar) * level


def shoulder_sheet(vertices: FloatArray, rng: np.random.Generator) -> Mesh:
    """Return a sheet of clothes below a face: over both shoulders, open at the neck, with folds."""
    origin = nose_tip(vertices)
    rows = 50
    columns = 130
    x = np.linspace(-185, 185, columns)[None] * np.ones((rows, 1))
    down = np.linspace(0, 1, rows)[:, None] * np.ones((1, columns))
    crest = -126 - 50 * np.abs(x / 185) ** 1.5
    folds = gaussian_filter(rng.normal(size=(rows, columns)), (6, 2.5))
    y = crest - 105 * down**1.2
    z = -135 + 78 * np.sin(down * np.pi / 2) - 35 * (x / 185) ** 2 + 2.5 * folds / folds.std()
    sheet, faces = np.stack([x, y, z], -1).reshape(-1, 3) + origin, grid_faces(rows, columns)
    flat_x, flat_down = x.ravel(), down.ravel()
    opening = np.abs(flat_x) < 58 * (1 - flat_down) + 3 * np.sin(9 * flat_down)
    return compact(sheet, faces[~opening[faces].any(1)])


def crumb_meshes(vertices: FloatArray, rng: np.random.Generator, count: int) -> list[Mesh]:
    """Return `count` loose patches of a few triangles floating near the surface."""
    parts = []
    for _ in range(count):
        anchor = vertices[rng.integers(len(vertices))]
        outward = anchor - vertices.mean(0)
        center = anchor + outward / np.linalg.norm(outward) * rng.uniform(6, 30)
        parts.append((center + rng.normal(scale=rng.uniform(1.5, 4), size=(9, 3)), grid_faces(3, 3)))
    return parts


def compact(vertices: FloatArray, faces: IntArray) -> Mesh:
    """Return the mesh without unreferenced vertices."""
    kept, renumbered = without_unreferenced(vertices, faces)
    return vertices[kept], renumbered


def head_around(
    vertices: FloatArray, faces: IntArray, normals: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return skull and neck as a collar of 60 rings around the rim of a disc-shaped face that looks along +z.

    For B rim vertices these are vertices (60 B, 3) mm, ring 0 on the rim; faces (F', 3); and uv (60 B, 2)
    around and along, in units of the face's chart (about 1 for 200 mm).
    """
    loop = boundary_loop(len(vertices), faces)
    rings = 60
    rim, tip = vertices[loop], nose_tip(vertices)
    # Unit vectors that leave the surface across its rim, smoothed along it.
    outward = normalized(np.cross(np.roll(rim, -1, axis=0) - np.roll(rim, 1, axis=0), normals[loop]))
    for _ in range(12):
        outward = normalized(outward + np.roll(outward, 1, axis=0) + np.roll(outward, -1, axis=0))
    share = np.linspace(0, 1, rings)[:, None, None]
    skull, neck = _skull(rim, outward, tip, share), _neck(rim, outward, tip, share)
    # The angle is 0 at the crown and pi at the chin.
    angle = np.abs(np.arctan2(rim[:, 0], rim[:, 1] - (rim[:, 1].max() + rim[:, 1].min()) / 2))
    chin = smoothstep((angle - np.deg2rad(95)) / np.deg2rad(40))[None, :, None]
    collar = (1 - chin) * skull + chin * neck
    around = np.cumsum(norms(rim - np.roll(rim, 1, axis=0)))
    uv = np.stack(np.broadcast_arrays(around[None] / 200, share[..., 0]), -1)
    return collar.reshape(-1, 3), grid_faces(rings, len(loop), wrap=True), uv.reshape(-1, 2)


def _skull(rim: FloatArray, outward: FloatArray, tip: FloatArray, share: FloatArray) -> FloatArray:
    """Return rings (R, B, 3) from the rim, along its own slope, onto an ellipsoid and toward its back."""
    center = tip + SKULL_CENTER_FROM_NOSE_MM
    sway = share * 1.15
    direction = normalized((1 - sway) * normalized(rim - center) + sway * np.array([0.0, 0.1, -1.0]) + 1e-9)
    ellipsoid = center + direction / np.linalg.norm(direction / SKULL_SEMI_AXES_MM, axis=-1, keepdims=True)
    straight = rim + outward * share * 200
    return straight + (ellipsoid - straight) * smoothstep(share / 0.3)


def _neck(rim: FloatArray, outward: FloatArray, tip: FloatArray, share: FloatArray) -> FloatArray:
    """Return rings (R, B, 3) on Hermite curves from the rim under the chin to an ellipse at its base."""
    sideways = rim[:, 0] / np.abs(rim[:, 0]).max()
    turn = sideways * np.deg2rad(120)
    x, z = tip[0] + 62.0 * np.sin(turn), tip[2] - 118.0 + 60.0 * np.cos(turn)
    base = np.stack([x, np.full(len(rim), tip[1] - 190.0), z], 1)
    leave = outward * 110 + np.array([0.0, 0.0, -60.0])
    arrive = np.array([0.0, -170.0, 0.0]) + 110 * sideways[:, None] * np.array([1.0, 0.0, 0.0])
    return CubicHermiteSpline([0, 1], [rim, base], [leave, arrive])(share[:, 0, 0])
