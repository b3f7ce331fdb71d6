"""What surrounds a synthetic face: skull and neck, hair, clothes; floating crumbs and holes."""

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.core.arrays import FloatArray, IntArray, smoothstep
from scan2albedo.geometry.mesh import normalized, without_unreferenced
from scan2albedo.geometry.parametrization import boundary_loop
from scan2albedo.synthetic.renderer import RayScene

Mesh = tuple[FloatArray, IntArray]

SKULL_CENTER_FROM_NOSE_MM = np.array([0.0, 40.0, -105.0])
HEAD_AXIS_FROM_NOSE_MM = np.array([0.0, 0.0, -100.0])
SKULL_SEMI_AXES_MM = np.array([74.0, 108.0, 105.0])


def nose_tip(vertices: FloatArray) -> FloatArray:
    """Return (3,) the foremost vertex of a face that looks along +z."""
    return vertices[np.argmax(vertices[:, 2])]


def join(meshes: list[Mesh]) -> Mesh:
    """Return one mesh holding all the given ones as loose parts, in order."""
    offsets = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    faces = np.concatenate([f + o for (_, f), o in zip(meshes, offsets, strict=True)])
    return np.concatenate([v for v, _ in meshes]), faces


def grid_faces(rows: int, columns: int, *, wrap: bool = False) -> IntArray:
    """Return (F, 3) triangles of a rows x columns vertex grid; `wrap` joins the last column to the first."""
    index = np.arange(rows * columns).reshape(rows, columns)
    if wrap:
        index = np.concatenate([index, index[:, :1]], 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])


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
    right, crown = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.75, -0.66])
    forward = np.cross(right, crown)
    forward *= np.sign(forward[2]) / np.linalg.norm(forward)
    level = np.cos(around)[:, None] * forward + np.sin(around)[:, None] * right
    directions = np.cos(polar) * (crown / np.linalg.norm(crown)) + np.sin(polar) * level
    flat = directions.reshape(-1, 3)
    far = 400.0
    hits = RayScene(vertices, faces).first_hit(center + far * flat, -flat)
    skull = 1 / np.linalg.norm(flat / SKULL_SEMI_AXES_MM, axis=1)
    surface = np.where(hits.face >= 0, far - hits.distance, 0.0)
    radius = gaussian_filter(np.maximum(skull, surface).reshape(size), (3, 5), mode=("nearest", "wrap"))
    # Strands that run from the crown down, over broader waves, in mm.
    locks = np.zeros(size)
    for amplitude, sigma in ((0.6, (9, 1.2)), (1.3, (14, 3.5)), (2.2, (12, 14))):
        noise = gaussian_filter(rng.normal(size=size), sigma, mode=("nearest", "wrap"))
        locks += amplitude * noise / noise.std()
    radius += 0.8 + (thickness_mm - 0.8) * np.sqrt(1 - share**2) + locks * (1.2 - share)
    return (center + radius[..., None] * directions).reshape(-1, 3), grid_faces(*size, wrap=True)


def shoulder_sheet(vertices: FloatArray, rng: np.random.Generator) -> Mesh:
    """Return a sheet of clothes below a face: over both shoulders, open at the neck, with folds."""
    origin = nose_tip(vertices)
    rows, columns = 50, 130
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
    loop, rings = boundary_loop(len(vertices), faces), 60
    rim, tip = vertices[loop], nose_tip(vertices)
    # Unit vectors that leave the surface across its rim, smoothed along it.
    outward = normalized(np.cross(np.roll(rim, -1, axis=0) - np.roll(rim, 1, axis=0), normals[loop]))
    for _ in range(12):
        outward = normalized(outward + np.roll(outward, 1, axis=0) + np.roll(outward, -1, axis=0))
    share = np.linspace(0, 1, rings)[:, None, None]
    # Skull: from the rim, along its own slope, onto an ellipsoid and toward its back.
    center = tip + SKULL_CENTER_FROM_NOSE_MM
    sway = share * 1.15
    direction = normalized((1 - sway) * normalized(rim - center) + sway * np.array([0.0, 0.1, -1.0]) + 1e-9)
    ellipsoid = center + direction / np.linalg.norm(direction / SKULL_SEMI_AXES_MM, axis=-1, keepdims=True)
    straight = rim + outward * share * 200
    skull = straight + (ellipsoid - straight) * smoothstep(share / 0.3)
    # Neck: Hermite curves from the rim under the chin to an ellipse at the neck's base.
    sideways = rim[:, 0] / np.abs(rim[:, 0]).max()
    turn = sideways * np.deg2rad(120)
    x, z = tip[0] + 62.0 * np.sin(turn), tip[2] - 118.0 + 60.0 * np.cos(turn)
    base = np.stack([x, np.full(len(rim), tip[1] - 190.0), z], 1)
    leave = outward * 110 + np.array([0.0, 0.0, -60.0])
    arrive = np.array([0.0, -170.0, 0.0]) + 110 * sideways[:, None] * np.array([1.0, 0.0, 0.0])
    s = share
    neck = (
        (2 * s**3 - 3 * s**2 + 1) * rim
        + (s**3 - 2 * s**2 + s) * leave
        + (3 * s**2 - 2 * s**3) * base
        + (s**3 - s**2) * arrive
    )
    # The angle is 0 at the crown and pi at the chin.
    angle = np.abs(np.arctan2(rim[:, 0], rim[:, 1] - (rim[:, 1].max() + rim[:, 1].min()) / 2))
    chin = smoothstep((angle - np.deg2rad(95)) / np.deg2rad(40))[None, :, None]
    collar = (1 - chin) * skull + chin * neck
    around = np.cumsum(np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1))
    uv = np.stack(np.broadcast_arrays(around[None] / 200, share[..., 0]), -1)
    return collar.reshape(-1, 3), grid_faces(rings, len(loop), wrap=True), uv.reshape(-1, 2)
