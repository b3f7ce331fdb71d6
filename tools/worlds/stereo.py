"""Raw passive stereo of a synthetic person: coarse, noisy, in pieces, with much that is not a face.

Features hide, change or cut off the face: glasses, beards, hair, an open mouth; scraps show none.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, grid_faces, smoothstep
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import default_model
from scan2albedo.face_model.variation import EXPRESSION_BUMPS
from scan2albedo.geometry.mesh import normalized, vertex_components, vertex_normals
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_from_vector, transform_points
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.raw_scan import (
    capture,
    disturbed,
    portrait_pods,
    random_pose,
)
from scan2albedo.synthetic.sitter import (
    HEAD_AXIS_FROM_NOSE_MM,
    Mesh,
    compact,
    crumb_meshes,
    join,
    nose_tip,
    sit_down,
)
from worlds.raw_like import with_holes

CHANCES = {
    "glasses": 0.3,
    "open mouth": 0.25,
    "beard": 0.2,
    "fringe": 0.25,
    "half face": 0.1,
    "no neck": 0.4,
}
"""What may hide or change a face, and how often."""
FEATURES = tuple(CHANCES)
SCRAPS = ("hair", "ear", "cheek", "neck", "forehead", "back")
"""Places of which alone a scrap may show something, see `scrap_of`."""
FEATURE_LANDMARKS = slice(17, 68)
"""iBUG-68: brows, eyes, nose and mouth."""
_EYES = slice(36, 48)
_MOUTH = slice(48, 68)
_BROWS = slice(17, 27)
_CHIN = 8
_NOSE_BASE = 33
_FEWEST_FACES = 60
"""Triangles of a scrap at least."""
_SCRAP_SHARE = 0.15
"""Landmarks in a scrap's reach at most, of `FEATURE_LANDMARKS`."""
_PATCH = 5
"""Rows and columns of vertices of a stray patch."""


@dataclass(frozen=True, kw_only=True)
class StereoScanner:
    """Ranges from which each scan draws, as measured on raw stereo scans of real faces."""

    spacing_mm: tuple[float, float] = (3.5, 5.5)
    """Distance of neighbouring vertices."""
    noise_mm: tuple[float, float] = (0.4, 2.0)
    """Standard deviation along the normals."""
    stray: tuple[float, float] = (0.005, 0.2)
    """Part of the vertices that lies 200 mm to 1.3 m away; drawn by its logarithm."""
    pieces: tuple[int, int] = (9, 45)
    """Loose pieces, the face's own among them."""
    reach_mm: tuple[float, float] = (85.0, 170.0)
    """Distance from the middle of the face to which the head is measured."""
    holes: tuple[int, int] = (3, 20)
    """Holes of 3 to 12 mm radius."""


@dataclass(frozen=True)
class StereoTruth:
    """What is known about a scan."""

    model_from_scan: FloatArray
    """(4, 4): true pose: maps scan points into the model's frame, or that of the given shape, mm."""
    landmarks: FloatArray
    """(68, 3): true landmarks in that frame, mm; of a shut mouth, whatever it does."""
    expression: str
    """The one drawn; empty where the shape was given."""
    features: tuple[str, ...]
    """What was drawn, or asked for."""


@dataclass(frozen=True)
class _Head:
    """A head in mm that looks along +z, +y up, and its 68 landmarks (iBUG order), its mouth shut.

    `vertices` (V, 3) and `faces` (F, 3) hold all of it; `front` is its face, and `front_normals` are that
    mesh's, on which hair falls.
    """

    vertices: FloatArray
    faces: IntArray
    landmarks: FloatArray
    front: Mesh
    front_normals: FloatArray


def stereo_scan(
    seed: int = 0,
    *,
    capture_seed: int | None = None,
    features: tuple[str, ...] | None = None,
    scrap: str | None = None,
    scanner: StereoScanner = StereoScanner(),
) -> tuple[RawScan, StereoTruth]:
    """Return the untextured scan of a random person with a random expression, in any pose, and its truth.

    Two pods see the head. Stereo loses what is smooth, glassy or thin: strips behind glasses are missing, and
    their rims are loose shreds; an open mouth is a pit. Mismatches are patches along the line of sight, up to
    1.3 m off. ValueError where holes leave nothing.

    Parameters
    ----------
    seed : int
        Of the person and everything else; same seed, same scan.
    capture_seed : int, optional
        Of what differs between two scans of one shape: samples, noise, holes, strays, reach and pose.
    features : tuple of str, optional
        Names from `FEATURES`; drawn when None.
    scrap : str, optional
        One of `SCRAPS`: of the head there is only a scrap, which shows no face.
    scanner : StereoScanner
    """
    rng = np.random.default_rng([seed, 23])
    worn = _drawn_features(features, rng)
    names: list[Expression] = sorted(EXPRESSION_BUMPS)
    expression = names[rng.integers(len(names))]
    sitter = sit_down(
        seed,
        expression=expression,
        model=default_model(),
        expression_strength=rng.uniform(0.5, 1.5),
    )
    face = sitter.face
    head = _Head(sitter.vertices, sitter.faces, face.landmarks, (face.vertices, face.faces), face.normals)
    scan, pose = _scanned(head, worn, scrap, rng, (seed, capture_seed), scanner)
    return scan, StereoTruth(invert_rigid(pose), face.landmarks, expression, worn)


def stereo_scan_of(
    vertices: ArrayLike,
    faces: ArrayLike,
    landmarks: ArrayLike,
    seed: int = 0,
    *,
    capture_seed: int | None = None,
    features: tuple[str, ...] | None = None,
    scrap: str | None = None,
    scanner: StereoScanner = StereoScanner(),
) -> tuple[RawScan, StereoTruth]:
    """Return the untextured scan of a given head as `stereo_scan` makes it, and its truth.

    Features drawn or asked for change the head.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        Whole head, mm, anywhere; it looks along +z with +y up. Hair and clothes may be loose parts.
    faces : (F, 3) array_like of int
    landmarks : (68, 3) array_like of float
        Of the head, iBUG-68 order.
    seed : int
        Same seed, same features and scan.
    capture_seed, features, scrap, scanner
        As in `stereo_scan`.
    """
    points, index = np.asarray(vertices, float), np.asarray(faces, np.int64)
    marks = np.asarray(landmarks, float)
    rng = np.random.default_rng([seed, 29])
    worn = _drawn_features(features, rng)
    # The face is what is turned forward between chin, temples and hairline; the forehead is about as high
    # as the nose is long.
    normals = vertex_normals(points, index)
    brow = marks[_BROWS, 1].mean()
    top = brow + 0.9 * (brow - marks[_NOSE_BASE, 1])
    off = np.abs(points - marks.mean(0))[:, 0]
    forward = (normals[:, 2] > 0.2) & (off < np.ptp(marks[:, 0]) / 2)
    between = (points[:, 1] > marks[_CHIN, 1]) & (points[:, 1] < top)
    front = index[(forward & between & (points[:, 2] > marks[:17, 2].min()))[index].all(1)]
    head = _Head(points, index, marks, compact(points, front), normals[np.unique(front)])
    scan, pose = _scanned(head, worn, scrap, rng, (seed, capture_seed), scanner)
    return scan, StereoTruth(invert_rigid(pose), marks, "", worn)


def _drawn_features(wanted: tuple[str, ...] | None, rng: np.random.Generator) -> tuple[str, ...]:
    """Return the names wanted, drawn where that is None."""
    drawn = rng.uniform(size=len(FEATURES)) < list(CHANCES.values())
    if wanted is None:
        return tuple(name for name, there in zip(FEATURES, drawn, strict=True) if there)
    return wanted


def _scanned(
    head: _Head,
    features: tuple[str, ...],
    scrap: str | None,
    rng: np.random.Generator,
    seeds: tuple[int, int | None],
    scanner: StereoScanner,
) -> tuple[RawScan, FloatArray]:
    """Return the scan of a head with features, and `scan_from_head` (4, 4).

    `rng` draws the shape and, where the capture has no seed of its own in `seeds`, the capture.
    """
    tip = nose_tip(head.front[0])
    vertices, faces = join([(_shaped(head, features, rng), head.faces), *_worn(head, features, rng)])
    seed, capture_seed = seeds
    name = f"stereo-{seed}"
    if capture_seed is not None:
        name += f"-{capture_seed}"
        rng = np.random.default_rng([seed, capture_seed, 31])
    points, faces = _measured((vertices, faces), tip, scrap == "back", rng, scanner)
    gone = _lost(points, head.landmarks, features, rng)
    if scrap is None:
        middle = head.landmarks[FEATURE_LANDMARKS].mean(0) + rng.normal(scale=8, size=3)
        gone |= np.linalg.norm(points - middle, axis=1) > rng.uniform(*scanner.reach_mm)
    mesh = compact(points, faces[~gone[faces].any(1)])
    if scrap is not None:
        mesh = scrap_of(mesh, head.landmarks, scrap, rng)
    else:
        count = int(rng.integers(*scanner.holes, endpoint=True))
        mesh = with_holes(mesh, mesh[0][rng.choice(len(mesh[0]), count)], rng.uniform(3, 12, count))
    if len(mesh[1]) == 0:
        raise ValueError(f"nothing is left of the head: fewer holes or more reach are needed, not {scanner}")
    loose = crumb_meshes(mesh[0], rng, int(rng.integers(*scanner.pieces, endpoint=True)) - 1)
    loose += _stray_patches(mesh, rng, float(np.exp(rng.uniform(*np.log(scanner.stray)))))
    posed, faces = join([mesh, *loose])
    pose = random_pose(rng)
    return RawScan(transform_points(pose, posed), faces, name=name), pose


def _measured(
    mesh: Mesh, tip: FloatArray, behind: bool, rng: np.random.Generator, scanner: StereoScanner
) -> Mesh:
    """Return what two pods before a head measure, with noise; to show what is behind, it is turned around."""
    axis, turn = tip + HEAD_AXIS_FROM_NOSE_MM, np.eye(4)
    if behind:
        rotation = rotation_from_vector([0.0, np.pi + rng.uniform(-0.5, 0.5), 0.0])
        turn = compose(rotation, axis - rotation @ axis)
    turned, spacing = transform_points(turn, mesh[0]), rng.uniform(*scanner.spacing_mm)
    measured = capture(turned, mesh[1], portrait_pods(tip), spacing_mm=spacing, rng=rng, axis_mm=axis)
    noisy = disturbed(measured.vertices, measured.faces, rng, rng.uniform(*scanner.noise_mm), 10)
    return transform_points(invert_rigid(turn), noisy), measured.faces


def _stray_patches(mesh: Mesh, rng: np.random.Generator, share: float) -> list[Mesh]:
    """Return mismatches far in front of a mesh or behind it, of this share of all vertices."""
    count, center = len(mesh[0]), mesh[0].mean(0)
    patches = []
    for _ in range(max(1, round(share * count / (1 - share) / _PATCH**2))):
        sight = normalized(np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3), 1.0]))
        away = rng.choice([-1, 1], p=[0.7, 0.3]) * rng.uniform(200, 1300)
        spread = rng.normal(scale=rng.uniform(3, 12), size=(_PATCH**2, 3))
        patch = center + away * sight + rng.normal(scale=50, size=3) + spread
        patches.append((patch, grid_faces(_PATCH, _PATCH)))
    return patches


def _shaped(head: _Head, features: tuple[str, ...], rng: np.random.Generator) -> FloatArray:
    """Return the head's vertices (V, 3) with a jaw that is down, and a beard that stands off."""
    landmarks, vertices = head.landmarks, head.vertices.copy()
    mouth, chin = landmarks[_MOUTH].mean(0), landmarks[_CHIN]

    def near(center: FloatArray, radius_mm: float) -> FloatArray:
        return np.exp(-0.5 * (((vertices - center) / radius_mm) ** 2).sum(1) ** 2)

    if "open mouth" in features:
        drop = rng.uniform(6, 22)
        below = smoothstep((mouth[1] - vertices[:, 1]) / 6) * near(chin, 45)
        vertices[:, 1] -= drop * below
        vertices[:, 2] -= 0.35 * drop * below
        center, size = mouth - [0, drop / 2, 0], np.array([rng.uniform(14, 24), drop / 2 + 3, 30])
        inside = np.exp(-((np.abs((vertices - center) / size) ** 2).sum(1) ** 2))
        vertices[:, 2] -= rng.uniform(6, 16) * inside
    if "beard" in features:
        lower = smoothstep((mouth[1] + 4 - vertices[:, 1]) / 14) * near(chin, 55)
        lower *= 1 - near(mouth, 12)
        tufts = 1 + 0.35 * rng.normal(size=len(vertices))
        vertices += (rng.uniform(3, 12) * lower * tufts)[:, None] * vertex_normals(vertices, head.faces)
    return vertices


def _lens_centers(landmarks: FloatArray) -> list[FloatArray]:
    eyes = landmarks[_EYES].reshape(2, 6, 3).mean(1)
    return [eye + [side * 3.0, -2.0, 14.0] for eye, side in zip(eyes, (-1, 1), strict=True)]


def _worn(head: _Head, features: tuple[str, ...], rng: np.random.Generator) -> list[Mesh]:
    """Return the meshes of hair over the forehead and of the rims of glasses."""
    parts: list[Mesh] = []
    landmarks, (vertices, faces) = head.landmarks, head.front
    if "fringe" in features:
        brow = landmarks[_BROWS, 1].mean()
        top = vertices[:, 1].max()
        x = vertices[:, 0]
        ragged = 4 * np.sin(x / rng.uniform(3, 6)) + rng.uniform(-0.3, 0.3) * x
        above = vertices[:, 1] > top - rng.uniform(0.3, 0.75) * (top - brow) + ragged
        locks = rng.uniform(3, 9) * (1 + 0.2 * np.sin(x / 2.2))
        parts.append(compact(vertices + locks[:, None] * head.front_normals, faces[above[faces].all(1)]))
    if "glasses" in features:
        # A rim is an elliptic tube around the lens in the plane that faces +z.
        size = np.array([rng.uniform(22, 30), rng.uniform(16, 24)])
        turn, around = (np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (40, 8))
        line = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
        out = normalized(line * [*size[::-1], 1.0])[:, None]
        section = np.cos(around)[None, :, None] * out + np.sin(around)[None, :, None] * [0.0, 0.0, 1.0]
        triangles = grid_faces(len(turn) + 1, len(around), wrap=True)[:, ::-1]
        for center in _lens_centers(landmarks):
            tube = (center + line * [*size, 0.0])[:, None] + rng.uniform(1.5, 4) * section
            parts.append((np.concatenate([tube, tube[:1]]).reshape(-1, 3), triangles))
    return parts


def _lost(
    points: FloatArray, landmarks: FloatArray, features: tuple[str, ...], rng: np.random.Generator
) -> BoolArray:
    """Return which of the measured points (N, 3) the matching did not find."""
    gone = np.zeros(len(points), bool)
    if "glasses" in features:
        size = np.array([rng.uniform(16, 26), rng.uniform(10, 18)])
        for center in _lens_centers(landmarks):
            gone |= (((points - center)[:, :2] / size) ** 2).sum(1) < 1
    if "half face" in features:
        side = rng.choice([-1.0, 1.0])
        gone |= side * (points[:, 0] - landmarks[30, 0]) > rng.uniform(-4, 20)
    if "no neck" in features:
        gone |= points[:, 1] < landmarks[_CHIN, 1] - rng.uniform(-4, 45)
    return gone


def scrap_of(mesh: Mesh, landmarks: FloatArray, place: str, rng: np.random.Generator) -> Mesh:
    """Return the largest connected piece of a head around one of `SCRAPS`, which shows no face.

    It ends 5 mm before it reaches more than 15 % of the landmarks of brows, eyes, nose and mouth.
    """
    vertices, faces = mesh
    side = rng.integers(2)
    ear, cheek = landmarks[[0, 16][side]], landmarks[[[2, 31, 48], [14, 35, 54]][side]].mean(0)
    brows, chin = landmarks[_BROWS].mean(0), landmarks[_CHIN]
    outward = np.array([2.0 * side - 1, 0.0, 0.0])
    anchors = {
        "hair": brows + [0, 95, -60] + rng.uniform(-50, 50) * np.array([1.0, 0, 0]),
        "ear": ear + [0, 0, -25] + 10 * outward,
        "cheek": (ear + 2 * cheek) / 3 + 10 * outward,
        "neck": chin + [0, -65, -60],
        "forehead": brows + [0, 50, -5],
        "back": brows + [0, 0, -170] + rng.uniform(-60, 60) * np.array([1.0, 0, 0]),
    }
    anchor = np.asarray(anchors[place] + rng.normal(scale=8, size=3))
    distance = np.linalg.norm(vertices - anchor, axis=1)
    reach = rng.uniform(35, 90) + distance.min()
    features = np.linalg.norm(landmarks[FEATURE_LANDMARKS] - anchor, axis=1)
    reach = min(reach, np.quantile(features, _SCRAP_SHARE) - 5)
    # However far the surface ends from there, something is left of it.
    reach = max(reach, np.sort(distance[faces].max(1))[_FEWEST_FACES - 1])
    kept = faces[(distance <= reach)[faces].all(1)]
    piece = vertex_components(len(vertices), kept)
    largest = np.bincount(piece[kept[:, 0]]).argmax()
    return compact(vertices, kept[piece[kept[:, 0]] == largest])
