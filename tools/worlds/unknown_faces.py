"""Photographs of faces that no model here knows, made by code that shares nothing with the fit.

Shapes are those of ../shared/data/ict_faces.npz; albedo is painted here in space, around their landmarks, or
looked up in the pictures of ../shared/data/traced. Mitsuba traces rough plastic skin with occlusion and
bounces under the lights of `lamps`; the picture gets a sensor's noise and 8 bits. The mesh is what
`scan2albedo.fit` finds on the shape, so that vertices do not correspond exactly either.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

import scan2albedo as s2a
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, look_at, pixel_directions, pixel_grid, project
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.images import read_image_linear
from scan2albedo.lighting.environment import texel_directions
from scan2albedo.lighting.harmonics import project_environment
from worlds.files import face_data
from worlds.fits import fitted_face
from worlds.lamps import Environment, Part, Rig, overcast, rig_named
from worlds.light_stage import NEUTRAL, LightStage
from worlds.path_tracer import bitmap, rough_plastic, textured_mesh
from worlds.pictures import along, filled_outline

LEVEL = 1
"""Subdivisions of the default model's surface that is fitted."""
SIZE = 320
"""Rows and columns of a photograph."""
PATHS = 48
"""Of a pixel."""
DEPTH = 5
"""Longest path in edges."""
CAMERA_MM = 900.0
"""Distance of the camera from the bridge of the nose."""
FOCAL_PX = 1100.0
GAMMA = 1.2
"""Of the displayed values."""
WHITE = 0.85
"""Exposure puts the brightest skin here (995 of 1000 pixels are darker)."""
SATURATION = 0.98
BLUR_PX = 1.0
"""Standard deviation of the lens."""
RELIT = Rig("relit", (Part(Environment("overcast"), 1.0),))
_TEXTURE = (1024, 2048)
"""Texels of the albedo's chart, two tiles beside each other."""
_NOISE = 0.006
"""Standard deviation of a white pixel's noise; it falls with the square root of the light."""
_FARTHEST_MM = 2.0
"""Vertices of the fitted mesh that are farther from the shape have no true albedo."""
_TONES = np.array(
    [[0.62, 0.42, 0.33], [0.52, 0.33, 0.25], [0.42, 0.26, 0.18], [0.30, 0.18, 0.115], [0.15, 0.085, 0.06]]
)
"""Linear albedo of skin from pale to dark."""
_LIP = np.array([0.85, 0.55, 0.58])
"""Albedo of lips over that of the skin."""
_HAIR = np.array([0.06, 0.045, 0.035])
SHAPES = (*NEUTRAL[1:], NEUTRAL[0])
TRACED = ("p105_front", "p106_gloss", "p108_smile_m")
LIGHTS = ("softbox_side", "sky", "lamp_room", "window", "softboxes2", "sun", "dome", "flash")
PEOPLE = ("p108_smile_m", "paint-43", "paint-41", "paint-42", "paint-40", "paint-57")
"""From pale to dark, for fits of landmarks."""
PEOPLES_LIGHTS = ("window", "softboxes2", "sun")
"""What each of them is photographed in."""
_LANDMARK_NOISE_PX = 1.0
"""Standard deviation of a hand that places landmarks."""


@dataclass(frozen=True)
class UnknownFace:
    """One case: whose shape, whose skin, which light, from where.

    The skin is "paint-N", a traced scan's name, or "mean", the model's own mean, where nothing is better.
    """

    shape: str
    skin: str
    light: str
    azimuth_deg: float
    alpha: float

    @property
    def name(self) -> str:
        return f"{self.shape}_{self.skin}_{self.light}"


def unknown_faces(count: int) -> list[UnknownFace]:
    """Return as many cases; of eight, three have the skin of a traced scan and one the model's mean."""
    cases = []
    for k in range(count):
        skin = TRACED[(k // 3) % 3] if k % 8 in (1, 4, 7) else f"paint-{k}"
        skin = "mean" if k % 8 == 6 else skin
        cases.append(_drawn(SHAPES[k % 5], skin, LIGHTS[(3 * k + k // 8) % 8], [k, 77]))
    return cases


def faces_with_landmarks() -> list[UnknownFace]:
    """Return six people in three lights each; no other case has their skins."""
    cases = []
    for k, skin in enumerate(PEOPLE):
        for j, light in enumerate(PEOPLES_LIGHTS):
            cases.append(_drawn(SHAPES[(k + j) % 4], skin, light, [k, j, 81]))
    return cases


def _drawn(shape: str, skin: str, light: str, seed: list[int]) -> UnknownFace:
    rng = np.random.default_rng(seed)
    return UnknownFace(shape, skin, light, float(rng.uniform(-25, 25)), float(rng.uniform(0.25, 0.4)))


def landmarks_of(face: UnknownFace) -> FloatArray:
    """Return the 68 landmarks (68, 2) in the picture, placed by a hand that is a pixel off."""
    pixels, _ = project(camera_of(face), head(face.shape).landmarks)
    noise = np.random.default_rng([int(1e4 * face.alpha), 80]).normal(size=pixels.shape)
    return np.asarray(pixels + _LANDMARK_NOISE_PX * noise)


def seen_albedo(face: UnknownFace, mean: FloatArray, vertices: FloatArray) -> FloatArray:
    """Return the true albedo (V, 3) where vertices lie in the picture; NaN beside the face."""
    one, camera = head(face.shape), camera_of(face)
    toward = pixel_directions(camera, project(camera, vertices)[0])
    center = np.broadcast_to(camera_centers(camera[None])[0], toward.shape)
    hits = RayCaster(one.vertices, one.faces).first_hit(center, toward)
    albedo = albedo_of(face, mean)[one.faces[np.maximum(hits.face, 0)]]
    seen = np.einsum("nk,nkc->nc", np.nan_to_num(hits.barycentric), albedo)
    seen[(hits.face < 0) | ~one.on_face[np.maximum(hits.face, 0)]] = np.nan
    return seen


@dataclass(frozen=True)
class Head:
    """A shape, refined, with (68, 3) landmarks; `on_face` (F,) are the triangles of the face."""

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    landmarks: FloatArray
    coarse_corners: IntArray
    """(V, 2): the coarse vertices that each vertex is the middle of, twice the same one for their own."""
    on_face: BoolArray
    corner_uv: FloatArray
    """(F, 3, 2): within the unit square, v upward."""


@cache
def head(shape: str) -> Head:
    """Return a shape, its triangles divided once into four, the bridge of its nose at the origin."""
    stage = LightStage.load()
    bridge = stage.shapes[shape][stage.landmarks[27:36]].mean(0)
    coarse, triangles = stage.shapes[shape] - bridge, stage.faces
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ends, edge_of = np.unique(edges, axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = triangles.T, (len(coarse) + edge_of.reshape(-1, 3)).T
    faces = _quarters(a, b, c, ab, bc, ca)
    vertices = np.concatenate([coarse, coarse[ends].mean(1)])
    own = np.repeat(np.arange(len(coarse))[:, None], 2, axis=1)
    a, b, c = np.moveaxis(stage.corner_uv * [0.5, 1.0], 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return Head(
        vertices,
        faces,
        vertex_normals(vertices, faces),
        coarse[stage.landmarks],
        np.concatenate([own, ends]),
        np.arange(len(faces)) < 4 * len(stage.face_area),
        _quarters(a, b, c, ab, bc, ca),
    )


def _quarters(*corners: NDArray) -> NDArray:
    """Return the four parts (4 F, 3, ...) of triangles by their corners and the middles of their edges."""
    a, b, c, ab, bc, ca = corners
    parts = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1)
    return parts.reshape(-1, 3, *a.shape[1:])


@cache
def fitted_vertices(shape: str) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and triangles of the default model's surface as fitted to a shape."""
    model, one = s2a.AnnotatedFaceModel.default(), head(shape)
    fitted = fitted_face(s2a.RawScan(one.vertices, one.faces[one.on_face]), model)
    subdivision = model.subdivision(LEVEL)
    in_model = subdivision.matrix @ fitted.control_points
    return transform_points(np.linalg.inv(np.asarray(fitted.model_from_scan)), in_model), subdivision.faces


def albedo_of(face: UnknownFace, mean: FloatArray) -> FloatArray:
    """Return the linear albedo (V, 3) of the head's vertices; `mean` is the model's, at its own ones."""
    one = head(face.shape)
    if face.skin == "mean":
        vertices, faces = fitted_vertices(face.shape)
        nearest = ClosestPointQuery(vertices, faces).query(one.vertices)
        return nearest.interpolated(mean, faces)
    if face.skin.startswith("paint"):
        return painted(one, int(face.skin.split("-")[1]))
    return traced_albedo(face.skin)[one.coarse_corners].mean(1)


def traced_albedo(name: str) -> FloatArray:
    """Return (V, 3) of the coarse vertices, from the albedo picture of a traced scan."""
    with np.load(face_data(f"traced/{name}_truth.npz")) as truth:
        uv, faces = truth["uv_corners"].astype(float), truth["faces"].astype(np.int64)
        count = len(truth["vertices_mm"])
    picture = read_image_linear(face_data(f"traced/{name}_albedo.png")).astype(float)
    height, width = picture.shape[:2]
    row = np.clip(((1 - uv[..., 1]) * height).astype(int), 0, height - 1)
    column = np.clip((uv[..., 0] * width).astype(int), 0, width - 1)
    albedo = np.zeros((count, 3))
    albedo[faces.ravel()] = picture[row, column].reshape(-1, 3)
    return np.maximum(albedo, 0.01)


def painted(one: Head, seed: int) -> FloatArray:
    """Return (V, 3) of a person painted in space: tone, zones, blotches, brows, lips, stubble, marks."""
    rng = np.random.default_rng([seed, 78])
    x, marks = one.vertices, one.landmarks
    albedo = np.exp(_painted_skin(one, rng))
    lips = inside(x, marks[48:60], 2.0)[:, None] * (x[:, 2] > marks[48, 2] - 15)[:, None]
    albedo *= 1 - rng.uniform(0.5, 1.0) * lips * (1 - _LIP)
    density = rng.uniform(0.35, 0.9)
    for brow in (marks[17:22], marks[22:27]):
        reach, _ = cKDTree(along(brow, np.linspace(0, 4, 60))).query(x)
        hair = density * np.exp(-((reach / rng.uniform(3.0, 5.0)) ** 4))[:, None]
        albedo += hair * (_HAIR * rng.uniform(0.6, 2.5) - albedo)
    return np.clip(albedo, 0.01, 0.9)


def _painted_skin(one: Head, rng: np.random.Generator) -> FloatArray:
    """Return (V, 3) the logarithm of albedo before lips and brows are painted."""
    x, marks = one.vertices, one.landmarks
    mix = rng.uniform(0, len(_TONES) - 1)
    tone = along(_TONES, mix)
    log = np.log(tone) + 0.06 * rng.normal(size=3) + np.zeros((len(x), 1))
    red, brown = np.array([-0.15, -1.0, -0.8]), np.array([-0.6, -0.9, -1.1])
    for wave_mm, size in ((70.0, 0.06), (25.0, 0.05), (9.0, 0.035)):
        log += size * waves(x, wave_mm, rng)[:, None] * red
        log += 0.8 * size * waves(x, wave_mm, rng)[:, None] * brown
    for at, radius_mm, most in (
        (marks[[31, 41, 48, 2]].mean(0), 17.0, 0.35),
        (marks[[35, 46, 54, 14]].mean(0), 17.0, 0.35),
        (marks[30], 12.0, 0.3),
        (marks[8], 16.0, 0.15),
    ):
        log += rng.uniform(0, most) * near(x, at, radius_mm)[:, None] * red
    below = [marks[eye].mean(0) - [0, 9, 0] for eye in (slice(36, 42), slice(42, 48))]
    log -= rng.uniform(0, 0.25) * np.sum([near(x, at, 9.0) for at in below], axis=0)[:, None]
    if rng.uniform() < 0.5:
        log -= rng.uniform(0.1, 0.5) * stubble(x, marks, rng)[:, None] * [1.0, 0.9, 0.75]
    for _ in range(rng.integers(0, 3)):
        spot = x[one.faces[rng.choice(np.flatnonzero(one.on_face)), 0]]
        strength, radius = rng.uniform(0.2, 0.6), rng.uniform(3, 12)
        log += strength * near(x, spot, radius)[:, None] * (red, brown)[rng.integers(2)]
    return log


def waves(x: FloatArray, length_mm: float, rng: np.random.Generator) -> FloatArray:
    """Return (N,) smooth noise of unit variance in space."""
    k = rng.normal(size=(40, 3)) * (2 * np.pi / length_mm) / np.sqrt(3)
    return np.sqrt(2 / 40) * np.cos(x @ k.T + rng.uniform(0, 2 * np.pi, 40)).sum(1)


def near(x: FloatArray, at: FloatArray, radius_mm: float) -> FloatArray:
    """Return (N,) 1 at a point, falling off around it."""
    return np.exp(-np.sum((x - at) ** 2, 1) / (2 * radius_mm**2))


def inside(x: FloatArray, outline: FloatArray, soft_mm: float) -> FloatArray:
    """Return (N,) 1 inside an outline (K, 3) as seen from the front."""
    fill = filled_outline(outline[:, :2], 200, np.linspace(0, 1, 12))
    reach, _ = cKDTree(fill).query(x[:, :2])
    return np.clip(1.3 - reach / soft_mm, 0, 1)


def stubble(x: FloatArray, marks: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (N,) density of shaven hair below nose and cheeks."""
    low = 1 / (1 + np.exp((x[:, 1] - marks[33, 1] + 6 + 0.15 * np.abs(x[:, 0])) / 3))
    return low * (1 - inside(x, marks[48:60], 3.0)) * np.clip(0.8 + 0.2 * waves(x, 8.0, rng), 0, 1.3)


@dataclass(frozen=True)
class UnknownPhotograph:
    """A picture (H, W, 3), its camera (3, 4) and skin, the fitted mesh, and the truth at its vertices."""

    face: UnknownFace
    image: NDArray[np.uint8]
    skin: BoolArray
    camera: FloatArray
    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray
    """(V, 3); NaN where the mesh is too far from the shape."""
    relit: FloatArray
    """(H, W, 3): linear light of the same face in another light."""
    relit_light: FloatArray
    """(81, 3): of that light."""


def photographed(face: UnknownFace, mean: FloatArray, folder: Path | None = None) -> UnknownPhotograph:
    """Return a photograph, from `folder` if it has been made before; `mean` as in `albedo_of`."""
    one, albedo = head(face.shape), albedo_of(face, mean)
    vertices, faces = fitted_vertices(face.shape)
    camera = camera_of(face)
    pixels = pixel_directions(camera, pixel_grid((SIZE, SIZE)))
    center = camera_centers(camera[None])[0]
    hits = RayCaster(one.vertices, one.faces).first_hit(np.broadcast_to(center, pixels.shape), pixels)
    skin = ((hits.face >= 0) & one.on_face[np.maximum(hits.face, 0)]).reshape(SIZE, SIZE)
    linear, relit = _traced(face, one, albedo, folder)
    rng = np.random.default_rng([int(1e4 * face.alpha), 79])
    linear = gaussian_filter(linear, (BLUR_PX, BLUR_PX, 0))
    exposed = linear * WHITE / np.quantile(linear[skin].max(1), 0.995)
    exposed = exposed + _NOISE * np.sqrt(np.clip(exposed, 0.01, 1)) * rng.normal(size=exposed.shape)
    image = np.round(255 * np.clip(exposed, 0, 1) ** (1 / GAMMA)).astype(np.uint8)
    found = ClosestPointQuery(one.vertices, one.faces).query(vertices)
    truth = found.interpolated(albedo, one.faces)
    truth[(found.distance > _FARTHEST_MM) | ~one.on_face[found.face]] = np.nan
    around = overcast(texel_directions((64, 128)).reshape(-1, 3)).reshape(64, 128, 3)
    light = project_environment(around)
    return UnknownPhotograph(face, image, skin, camera, vertices, faces, truth, relit, light)


def camera_of(face: UnknownFace) -> FloatArray:
    """Return the projection matrix (3, 4)."""
    angle = np.deg2rad(face.azimuth_deg)
    position = CAMERA_MM * np.array([np.sin(angle), 0.05, np.cos(angle)])
    return np.asarray(look_at(position, np.zeros(3), focal_px=FOCAL_PX, shape=(SIZE, SIZE)))


def _traced(
    face: UnknownFace, one: Head, albedo: FloatArray, folder: Path | None
) -> tuple[FloatArray, FloatArray]:
    """Return the pictures (H, W, 3) in the face's light and in the other one."""
    file = None if folder is None else folder / f"{face.name}.npz"
    if file is not None and file.exists():
        with np.load(file) as stored:
            return stored["linear"].astype(float), stored["relit"].astype(float)
    linear, relit = (traced_picture(face, one, albedo, rig) for rig in (rig_named(face.light), RELIT))
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(file, linear=linear.astype(np.float32), relit=relit.astype(np.float32))
    return linear, relit


def traced_picture(face: UnknownFace, one: Head, albedo: FloatArray, rig: Rig) -> FloatArray:
    """Return the linear picture (H, W, 3) of a head of rough plastic under the parts of a rig."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    # The albedo (V, 3) as a picture on the shape's chart, without gaps.
    corners = one.faces.ravel()
    apart = np.arange(len(corners)).reshape(-1, 3)
    uv = one.corner_uv.reshape(-1, 2)
    raster = rasterize_uv(uv, apart, _TEXTURE)
    row, column = distance_transform_edt(raster.face < 0, return_distances=False, return_indices=True)
    picture = interpolate(raster, one.faces, albedo)[row, column].astype(np.float32)
    properties = mitsuba.Properties()
    plastic = rough_plastic(bitmap(mitsuba, picture), alpha=face.alpha, int_ior=1.4)
    properties["bsdf"] = mitsuba.load_dict(plastic)
    surface = one.vertices[corners], one.normals[corners], apart, uv * [1, -1] + [0, 1]
    mesh = textured_mesh(mitsuba, *surface, properties, "head")

    position = camera_centers(camera_of(face)[None])[0].tolist()
    sensor = {
        "type": "perspective",
        "fov": float(np.rad2deg(2 * np.arctan(SIZE / 2 / FOCAL_PX))),
        "near_clip": 10.0,
        "far_clip": 1e5,
        "to_world": mitsuba.ScalarTransform4f().look_at(origin=position, target=[0, 0, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    }
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": DEPTH}, "head": mesh}
    total = np.zeros((SIZE, SIZE, 3))
    for number, part in enumerate(rig.parts):
        sampler = {"type": "independent", "sample_count": PATHS, "seed": number}
        plugins = {"sensor": sensor | {"sampler": sampler}, **part.emitter.plugins(mitsuba)}
        total += part.linear * np.array(mitsuba.render(mitsuba.load_dict(scene | plugins)))[..., :3]
    return total
