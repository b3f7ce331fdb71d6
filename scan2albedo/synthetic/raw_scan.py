"""Raw scans of a synthetic person by a two-pod stereo scanner with flash photographs, and their truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from scan2albedo.core import GeometryImage, PointLight, RawScan
from scan2albedo.core.arrays import Float32Array, FloatArray, IntArray, dots, norms, on_grid
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry import pinhole, rigid
from scan2albedo.geometry.mesh import face_normals, normalized, vertex_normals
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.geometry.parametrization import signed_areas
from scan2albedo.synthetic import sitter as seated
from scan2albedo.synthetic.face_shape import Expression, face_geometry_image
from scan2albedo.synthetic.renderer import Material, RayScene, auto_exposure, photograph, render, toward
from scan2albedo.synthetic.scenes import light_at, texel_coordinates
from scan2albedo.synthetic.textures import LOOKS

_LEAST_COSINE = 0.12
"""Between a triangle's normal and a ray that still measures it."""

AmbientLight = Callable[[seated.Sitter, RayScene, np.random.Generator], FloatArray]
"""Gives the ambient light (V, 3) on a sitter's vertices."""


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """How a scan of a person is taken."""

    spacing_mm: float = 2.2
    """Distance of neighbouring samples on the head."""
    noise_mm: float = 0.2
    """Standard deviation of the noise along the normals."""
    holes: int = 5
    spikes: int = 15
    crumbs: int = 5
    """`holes`, `spikes`, `crumbs`: holes of 2 to 6 mm radius, vertices thrown off, loose patches in the
    air."""
    rotation_max_deg: float = 180.0
    """As in `random_pose`."""
    picture_size: int = 900
    """Height and width of each pod's picture in pixels."""
    size: int = 512
    """Texels of the truth's geometry image."""


def pod(
    center: FloatArray, angles_deg: tuple[float, float], *, reach_mm: float, distance_mm: float = 1000.0
) -> FloatArray:
    """Return a camera (3, 4) that looks from an azimuth and elevation at `center` (3,) +- `reach_mm`.

    It projects to texture coordinates of its square picture, 0 to 1.
    """
    place, focal = center + distance_mm * toward(*angles_deg), distance_mm / (2 * reach_mm)
    camera = pinhole.look_at(place, center, focal_px=focal, shape=(1, 1))
    return np.array([[1, 0, 0.5], [0, -1, 0.5], [0, 0, 1]]) @ camera


def two_pods(center: FloatArray, *, reach_mm: float) -> FloatArray:
    """Return pods (2, 3, 4) 1 m off, at the subject's left and right; see `pod`."""
    return np.stack([pod(center, (yaw_deg, 5.0), reach_mm=reach_mm) for yaw_deg in (35.0, -35.0)])


def portrait_pods(nose_tip: FloatArray) -> FloatArray:
    """Return the pods (2, 3, 4) before a person, whose pictures hold hair and shoulders."""
    return two_pods(nose_tip + [0.0, -15.0, -70.0], reach_mm=205.0)


@dataclass(frozen=True)
class RangeMesh:
    """The mesh that the pods measured: `vertices` (V, 3) mm, exactly on the scene, `faces` (F, 3) outward.

    `face_pod` (F,) is the number of the pod that sees the face best and colours it.
    """

    vertices: FloatArray
    faces: IntArray
    face_pod: IntArray


def capture(
    vertices: FloatArray,
    faces: IntArray,
    pods: FloatArray,
    *,
    spacing_mm: float,
    rng: np.random.Generator,
    axis_mm: FloatArray,
) -> RangeMesh:
    """Sample a scene irregularly and keep what at least one of the `pods` (P, 3, 4) sees.

    Jittered horizontal rays toward a vertical axis through `axis_mm` (3,), about `spacing_mm` apart where
    they pass a head's surface, are triangulated in the unrolled cylinder. Triangles that bridge a jump in
    depth, lean too far away, or hide from all pods are dropped, as stereo matching does.
    """
    # Rays from a cylinder; unrolled coordinates are in mm at 100 mm radius.
    radius = 100.0
    far = 600.0
    widest = np.deg2rad(115)
    across = np.arange(-widest * radius, widest * radius, spacing_mm)
    up = np.arange(vertices[:, 1].min(), vertices[:, 1].max(), spacing_mm)
    unrolled = np.stack(np.meshgrid(across, up), -1).reshape(-1, 2)
    unrolled = unrolled + rng.uniform(-0.42, 0.42, unrolled.shape) * spacing_mm
    azimuth = unrolled[:, 0] / radius
    outward = np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], 1)
    foot = np.stack([np.full(len(azimuth), axis_mm[0]), unrolled[:, 1], np.full(len(azimuth), axis_mm[2])], 1)
    origins, rays = foot + far * outward, -outward
    scene = RayScene(vertices, faces)
    hits = scene.first_hit(origins, rays)
    seen = hits.face >= 0
    points = origins[seen] + hits.distance[seen, None] * rays[seen]
    triangles = _triangles(unrolled[seen], 2.5 * spacing_mm)
    normals = face_normals(points, triangles)
    leaning = -dots(normals, rays[seen][triangles[:, 0]])
    facing = _facing(scene, points, triangles, normals, pods)
    kept = (leaning > _LEAST_COSINE) & (facing.max(1) > _LEAST_COSINE)
    used, renumbered = np.unique(triangles[kept], return_inverse=True)
    numbered, facing = renumbered.reshape(-1, 3).astype(int), facing[kept]
    best = _leading_pod(len(used), numbered, facing)
    unseen = np.take_along_axis(facing, best[:, None], 1)[:, 0] < 0
    return RangeMesh(points[used], numbered, np.where(unseen, facing.argmax(1), best))


def _triangles(plane: FloatArray, longest_edge: float) -> IntArray:
    """Return counter-clockwise triangles (F, 3) of points (N, 2) without long edges."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(plane).simplices.astype(int)
    clockwise = signed_areas(plane, triangles) < 0
    triangles[clockwise] = triangles[clockwise][:, ::-1]
    corners = plane[triangles]
    longest = norms(corners - np.roll(corners, 1, axis=1)).max(1)
    return triangles[longest < longest_edge]


def _facing(
    scene: RayScene, points: FloatArray, triangles: IntArray, normals: FloatArray, pods: FloatArray
) -> FloatArray:
    """Return the cosine (F, P) between each triangle's normal and each pod, -1 where that cannot see it."""
    facing = np.empty((len(triangles), len(pods)))
    for k, (camera, place) in enumerate(zip(pods, pinhole.camera_centers(pods), strict=True)):
        toward_pod = normalized(place - points)
        hidden = np.asarray((np.abs(pinhole.project(camera, points)[0] - 0.5) > 0.4975).any(1))
        hidden[~hidden] = scene.occluded((points + toward_pod / 2)[~hidden], toward_pod[~hidden])
        cosine = dots(normals, toward_pod[triangles[:, 0]])
        facing[:, k] = np.where(hidden[triangles].any(1), -1.0, cosine)
    return facing


def _leading_pod(vertices: int, faces: IntArray, facing: FloatArray) -> IntArray:
    """Return (F,) the pod that sees each face best, averaged twelve times around: the seam is one line."""
    pods = facing.shape[1]
    lead = np.stack([facing[:, k] - np.delete(facing, k, axis=1).max(1) for k in range(pods)], 1)
    for k in range(pods):
        for _ in range(12):
            lead[:, k] = vertex_average(vertices, faces, lead[:, k])[faces].mean(1)
    return lead.argmax(1)


def disturbed(
    vertices: FloatArray, faces: IntArray, rng: np.random.Generator, noise_mm: float, spikes: int
) -> FloatArray:
    """Return the vertices with Gaussian noise along their normals and a few thrown far off."""
    offset = rng.normal(scale=noise_mm, size=len(vertices))
    thrown = rng.choice(len(vertices), spikes, replace=False)
    offset[thrown] += rng.uniform(3, 15, spikes) * rng.choice([-1, 1], spikes)
    return vertices + offset[:, None] * vertex_normals(vertices, faces)


def random_pose(
    rng: np.random.Generator, rotation_max_deg: float = 180.0, translation_max_mm: float = 300.0
) -> FloatArray:
    """Return a rigid transform (4, 4), each coordinate of its translation uniform in +- the maximum.

    The rotation is uniform for 180 degrees or more, else about a random axis by at most that angle.
    """
    if rotation_max_deg >= 180:
        rotation = rigid.random_rotation(rng)
    else:
        axis, angle = rng.normal(size=3), np.deg2rad(rotation_max_deg) * rng.uniform()
        rotation = rigid.rotation_from_vector(axis / np.linalg.norm(axis) * angle)
    return rigid.compose(rotation, rng.uniform(-1, 1, 3) * translation_max_mm)


def flash_pictures(
    sitter: seated.Sitter,
    pods: FloatArray,
    lights: tuple[PointLight, ...],
    material: Material,
    *,
    size: int,
    rng: np.random.Generator,
    noise: float = 0.004,
    colors: FloatArray | None = None,
    ambient: AmbientLight | None = None,
) -> tuple[Float32Array, float]:
    """Return both pods' pictures side by side (size, 2 size, 3), linear from 8 bits, and their exposure.

    The exposure keeps the face's brightest pixel just below white; clothes may clip, and have no highlight.
    `noise` is a standard deviation, white = 1, as of a good camera; `colors` (1 + L, 3) are those of the
    ambient light and of each lamp, white when None; `ambient` replaces the constant ambient light 1.
    """
    scene, radiances, faces_shown = RayScene(sitter.vertices, sitter.faces), [], []
    soft = None if ambient is None else ambient(sitter, scene, rng)
    tints = np.ones((1 + len(lights), 3)) if colors is None else colors
    for camera, place in zip(pods, pinhole.camera_centers(pods), strict=True):
        rays = pinhole.pixel_directions(camera, texel_coordinates(size))
        hits = scene.first_hit(np.broadcast_to(place, rays.shape), rays)
        hit = hits.face >= 0
        face, barycentric = hits.face[hit], hits.barycentric[hit]
        corners = sitter.faces[face]
        under = partial(
            render,
            *sitter.points_at(face, barycentric),
            sitter.albedo_at(face, barycentric),
            material=material,
            occluder=scene,
            view_direction=-rays[hit],
            specular_scale=sitter.specular_scale_at(face),
        )
        radiance, on_face = np.tile(LOOKS["backdrop"], (size * size, 1)), np.zeros(size * size, bool)
        around = np.ones(3) if soft is None else np.einsum("nk,nkc->nc", barycentric, soft[corners])
        unlit = under(()).radiance_linear
        lamps = [under((light,)).radiance_linear - unlit for light in lights]
        parts = zip([tints[0] * around, *tints[1:]], (unlit, *lamps), strict=True)
        radiance[hit] = np.asarray(sum(color * part for color, part in parts))
        on_face[hit] = sitter.part[face] == seated.BodyPart.FACE
        radiances.append(radiance.reshape(size, size, 3))
        faces_shown.append(radiance[on_face])
    exposure = auto_exposure(np.concatenate(faces_shown))
    both = np.concatenate(radiances, axis=1)
    return photograph(both, exposure=exposure, noise=noise, bits=8, rng=rng), exposure


@dataclass(frozen=True)
class SyntheticTruth:
    """Everything about a synthetic scan that the pipeline estimates."""

    model_from_scan: FloatArray
    """(4, 4): true pose: maps scan points into the model's frame."""
    image: GeometryImage
    """True position and normal of each texel of the model's chart (model's frame, mm)."""
    albedo_linear: Float32Array
    """(H, W, 3): true albedo on the model's chart; zeros outside ``image.mask``."""
    landmarks: FloatArray
    """(68, 3): true landmarks in the model's frame, mm."""
    control_points: FloatArray
    """(C, 3): control points of the true face, its fine relief left out, in the model's frame."""
    lights: tuple[PointLight, ...]
    """In the model's frame, relative to ambient = 1."""
    material: Material
    exposure: float
    """`material`, `exposure`: how the skin reflects, and the factor from radiance to the picture."""


def raw_scan(
    seed: int = 0,
    *,
    expression: Expression = "neutral",
    lights: Sequence[PointLight] | None = None,
    material: Material | None = None,
    model: AnnotatedSurface | None = None,
    scanner: Scanner = Scanner(),
) -> tuple[RawScan, SyntheticTruth]:
    """Return the scan of a random synthetic person by a virtual two-pod stereo scanner, and its truth.

    The scan is in a random pose; its texture holds both pods' pictures side by side.

    Parameters
    ----------
    seed : int
        Of the person, the noise and the pose; same seed, same scan.
    expression : str
        One of neutral, smile, frown, pout, puff, surprise.
    lights : sequence of PointLight, optional
        One flash at 0.9 m for even seeds, two for odd ones, when omitted.
    material : Material, optional
        Rough skin with a soft highlight when omitted.
    model : AnnotatedSurface, optional
        The default model when omitted; it needs landmarks.
    scanner : Scanner
    """
    sitter = seated.sit_down(seed, expression=expression, model=model or default_model())
    if lights is None and seed % 2 == 0:
        lights = (light_at(-32, 18, distance_mm=900.0, intensity=2.5),)
    elif lights is None:
        sides = ((40, 1.8), (-40, 1.4))
        lights = tuple(light_at(side, 15, distance_mm=900.0, intensity=level) for side, level in sides)
    skin = material or Material(0.3, 0.12, 14.0)
    rng = np.random.default_rng([seed, 7])
    return scan_of(sitter, tuple(lights), skin, scanner, rng, f"synthetic-{seed}")


def scan_of(
    sitter: seated.Sitter,
    flashes: tuple[PointLight, ...],
    material: Material,
    scanner: Scanner,
    rng: np.random.Generator,
    name: str,
    colors: FloatArray | None = None,
    ambient: AmbientLight | None = None,
) -> tuple[RawScan, SyntheticTruth]:
    """Scan a sitter as `raw_scan` does; see `flash_pictures` for `colors` and `ambient`."""
    tip = seated.nose_tip(sitter.face.vertices)
    pods, axis = portrait_pods(tip), tip + seated.HEAD_AXIS_FROM_NOSE_MM
    measured = capture(
        sitter.vertices, sitter.faces, pods, spacing_mm=scanner.spacing_mm, rng=rng, axis_mm=axis
    )
    scan_from_model = random_pose(rng, scanner.rotation_max_deg)
    texture, exposure = flash_pictures(
        sitter, pods, flashes, material, size=scanner.picture_size, rng=rng, colors=colors, ambient=ambient
    )
    scan = assembled(measured, pods, texture, scan_from_model, scanner, rng, name)
    image = face_geometry_image(sitter.model, sitter.face, scanner.size)
    skin = sitter.face_albedo(texel_coordinates(scanner.size)[image.mask.ravel()])
    albedo = on_grid(image.mask, skin.astype(np.float32))
    model_from_scan, landmarks = rigid.invert_rigid(scan_from_model), sitter.face.landmarks
    truth = SyntheticTruth(
        model_from_scan, image, albedo, landmarks, sitter.control_points, flashes, material, exposure
    )
    return scan, truth


def assembled(
    measured: RangeMesh,
    pods: FloatArray,
    texture: Float32Array,
    scan_from_model: FloatArray,
    scanner: Scanner,
    rng: np.random.Generator,
    name: str,
) -> RawScan:
    """Return the scan: noise, holes and crumbs on the measured mesh, textured by all pods, posed."""
    points = disturbed(measured.vertices, measured.faces, rng, scanner.noise_mm, scanner.spikes)
    centers = points[rng.choice(len(points), scanner.holes)]
    kept = np.ones(len(measured.faces), bool)
    for center, radius in zip(centers, rng.uniform(2, 6, scanner.holes), strict=True):
        kept &= (norms(points[measured.faces] - center) > radius).all(1)
    vertices, faces = seated.join(
        [(points, measured.faces[kept]), *seated.crumb_meshes(points, rng, scanner.crumbs)]
    )
    number = np.zeros(len(faces), int)
    number[: kept.sum()] = measured.face_pod[kept]
    uv = np.stack([pinhole.project(camera, vertices)[0] for camera in pods])[number[:, None], faces]
    pictured = (np.abs(uv - 0.5) < 0.5).all((1, 2))
    faces, uv = faces[pictured], atlas_uv(uv, number[:, None], len(pods))[pictured]
    used, renumbered = np.unique(faces, return_inverse=True)
    posed = rigid.transform_points(scan_from_model, vertices[used])
    return RawScan(posed, renumbered.reshape(-1, 3), uv=uv, texture_linear=texture, name=name)


def atlas_uv(uv: FloatArray, number: IntArray, pods: int) -> FloatArray:
    """Return texture coordinates (..., 2) of the pictures with a `number` (...) when all lie in a row."""
    return np.stack([(uv[..., 0] + number) / pods, uv[..., 1]], -1)
