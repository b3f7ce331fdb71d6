"""Raw scans of sitters, textured with path-traced photographs of two to five cameras, and their truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

import scan2albedo as s2a
from benchmarks.scan_files import write_obj
from benchmarks.traced_bake import LightTable, Studio, exposure_of, stored
from benchmarks.traced_lights import Rig, rigs
from benchmarks.traced_people import Person, face_part, other_parts, painted, seated
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.synthetic.raw_scan import RangeMesh, Scanner, assembled, beside, capture, pod, random_pose
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import HEAD_AXIS_FROM_NOSE_MM, BodyPart, Sitter, nose_tip

CAMERAS_DEG: dict[int, list[tuple[float, float]]] = {
    2: [(35, 5), (-35, 5)],
    3: [(0, 0), (55, 5), (-55, 5)],
    4: [(28, 12), (-28, -8), (75, 5), (-75, 5)],
    5: [(0, -12), (38, 10), (-38, 10), (80, 0), (-80, 0)],
}
"""Azimuth and elevation of the cameras by their number."""
CAMERA_MM, REACH_MM = 1000.0, 180.0
CENTER_FROM_NOSE_MM = np.array([0.0, -10.0, -60.0])
ALBEDO_TEXELS = 1024
SCANNER = Scanner(spacing_mm=2.0, noise_mm=0.15, spikes=8, holes=4, crumbs=4)
_BACKDROP = np.array([0.010, 0.016, 0.030])
_BEFORE_MM = 0.3
_LEAST_COSINE = 0.1


@dataclass(frozen=True, kw_only=True)
class ScanRecipe:
    """One raw scan, `unit_mm` the file's unit; poses and noise differ by `take`."""

    name: str
    rig: str
    cameras: int
    person: Person
    unit_mm: float = 1.0
    turned_deg: float = 180.0
    take: int = 0


def recipes() -> tuple[ScanRecipe, ...]:
    """Return the scans of the set."""

    def who(seed: int, tone: float, **features: object) -> Person:
        return Person(name=f"p{seed}", seed=seed, tone=tone, **features)  # type: ignore[arg-type]

    return (
        ScanRecipe(name="p201_dome", rig="dome", cameras=3, person=who(201, 0.3, stubble=0.8)),
        ScanRecipe(
            name="p202_sky_smile", rig="sky", cameras=4, person=who(202, 0.15, expression="smile", fringe=0.9)
        ),
        ScanRecipe(name="p203_softboxes6", rig="softboxes6", cameras=5, person=who(203, 0.95, gloss="oily")),
        ScanRecipe(
            name="p204_softbox_side", rig="softbox_side", cameras=2, person=who(204, 0.4, stubble=1.0)
        ),
        ScanRecipe(
            name="p205_window_open_m",
            rig="window",
            cameras=3,
            person=who(205, 0.2, mouth_deg=14.0, fringe=0.8),
            unit_mm=1000.0,
        ),
        ScanRecipe(
            name="p206_ring_coat", rig="ring", cameras=3, person=who(206, 0.1, gloss="coat"), turned_deg=25
        ),
        ScanRecipe(name="p207_lamp_room", rig="lamp_room", cameras=2, person=who(207, 0.55), turned_deg=25),
        ScanRecipe(name="p208_flash_oily", rig="flash_near", cameras=2, person=who(208, 0.7, gloss="oily")),
        ScanRecipe(
            name="p209_flashes2_smile",
            rig="flashes2",
            cameras=4,
            person=who(209, 0.25, gloss="oily", expression="smile"),
        ),
        ScanRecipe(
            name="p210_sun",
            rig="sun",
            cameras=3,
            person=who(210, 0.45, stubble=0.7, gloss="matte"),
            unit_mm=10.0,
        ),
    )


def pairs(heads: Path) -> tuple[ScanRecipe, ...]:
    """Return two scans each, in other light and expression, of people with the skin of every fourth head."""
    first, second = (
        ("window", "flash_near", "softboxes2", "sun"),
        ("flash_near", "sun", "lamp_room", "window"),
    )
    made = []
    for k, head in enumerate(sorted(heads.glob("*.obj"))[1::4]):
        one = Person(name=f"q{k}", seed=301 + k, tone=0.4, skin=head)
        other = replace(one, expression="smile" if k % 2 else "frown", mouth_deg=0.0 if k % 2 else 8.0)
        for take, (person, rig) in enumerate(((one, first[k]), (other, second[k]))):
            name = f"{one.name}_{rig}"
            made.append(ScanRecipe(name=name, rig=rig, cameras=3 - take, person=person, take=10 * take))
    return tuple(made)


def pods_around(center: FloatArray, count: int) -> FloatArray:
    """Return `count` cameras (count, 3, 4) whose pictures span REACH_MM to each side of `center` (3,)."""
    span = {"reach_mm": REACH_MM, "distance_mm": CAMERA_MM}
    return np.stack([pod(center, angles, **span) for angles in CAMERAS_DEG[count]])


@dataclass(frozen=True)
class Pictured:
    """What the pixels of K square pictures of S pixels show, row by row, picture by picture.

    `face` (K S S,) is the sitter's face, -1 for none; `albedo` (K S S, 3) linear; `direction` the rays'.
    """

    face: IntArray
    albedo: FloatArray
    direction: FloatArray
    position: FloatArray


def pictured(sitter: Sitter, person: Person, pods: FloatArray, size: int) -> Pictured:
    """Return what the cameras see through the centres of their pixels."""
    direction = np.concatenate([pixel_directions(camera, texel_coordinates(size)) for camera in pods])
    origin = np.repeat(camera_centers(pods), size * size, axis=0)
    hits = RayCaster(sitter.vertices, sitter.faces).first_hit(origin, direction)
    hit = hits.face >= 0
    albedo, position = np.zeros((len(hit), 3)), np.zeros((len(hit), 3))
    albedo[hit] = albedo_at(sitter, person, hits.face[hit], hits.barycentric[hit])
    position[hit] = np.einsum(
        "nk,nkc->nc", hits.barycentric[hit], sitter.vertices[sitter.faces[hits.face[hit]]]
    )
    return Pictured(hits.face, albedo, direction, position)


def albedo_at(sitter: Sitter, person: Person, face: IntArray, barycentric: FloatArray) -> FloatArray:
    """Return (N, 3) linear albedo at surface points of any part."""
    albedo = sitter.albedo_at(face, barycentric)
    on_face = sitter.part[face] == BodyPart.FACE
    uv = np.einsum("nk,nkc->nc", barycentric[on_face], sitter.corner_uv[face[on_face]])
    albedo[on_face] = painted(person, sitter, uv)
    return albedo


def used_pixels(measured: RangeMesh, pods: FloatArray, size: int) -> BoolArray:
    """Return (K S S,) which pixels colour the scan, two more around them."""
    marks = []
    for k, camera in enumerate(pods):
        u, v = project(camera, measured.vertices)[0].T
        pixel = size * np.stack([u, 1 - v], 1) - 0.5
        picture = np.zeros((size, size), np.uint8)
        for triangle in np.round(pixel[measured.faces[measured.face_pod == k]] * 16).astype(np.int32):
            cv2.fillConvexPoly(picture, triangle, 1, shift=4)
        marks.append(cv2.dilate(picture, np.ones((5, 5), np.uint8)).astype(bool).ravel())
    return np.concatenate(marks)


def filled(light: FloatArray, known: BoolArray, count: int, size: int) -> FloatArray:
    """Return light (K S S, 3); pixels that were not traced get that of the nearest one in their picture."""
    pictures, marks = light.reshape(count, size, size, 3), known.reshape(count, size, size)
    full = pictures.copy()
    for k in range(count):
        if marks[k].any():
            row, column = distance_transform_edt(~marks[k], return_distances=False, return_indices=True)
            full[k] = pictures[k][row, column]
    return full.reshape(light.shape)


@dataclass(frozen=True)
class Photographs:
    """Pictures and true albedo side by side, (S, K S, 3) linear; radiance times `exposure` is the picture."""

    texture: FloatArray
    albedo: FloatArray
    exposure: float


def photographs(
    recipe: ScanRecipe,
    sitter: Sitter,
    pods: FloatArray,
    used: BoolArray,
    *,
    size: int,
    paths: int,
    threads: int,
) -> Photographs:
    """Return path-traced photographs; pixels that are not `used` only look like it."""
    person, seen = recipe.person, pictured(sitter, recipe.person, pods, size)
    used = used & (seen.face >= 0)
    studio = Studio(
        [face_part(person, sitter, ALBEDO_TEXELS), *other_parts(person, sitter, size=1536)],
        nearest=False,
        threads=threads,
    )
    direction = seen.direction[used]
    start = seen.position[used] - _BEFORE_MM * direction
    rig = rig_named(recipe.rig)
    radiance = LightTable(studio, start, direction, paths, 1000 * person.seed).under(rig)
    skin = sitter.part[seen.face[used]] <= BodyPart.HEAD
    gain = exposure_of(radiance[skin])
    light = np.zeros_like(seen.albedo)
    light[used] = gain * radiance / np.maximum(seen.albedo[used], 1e-3)
    picture = seen.albedo * filled(light, used, len(pods), size)
    picture[used] = gain * radiance
    picture[seen.face < 0] = _BACKDROP
    rng = np.random.default_rng([person.seed, 33 + recipe.take])
    texture = row_of(stored(picture, rng), len(pods), size)
    return Photographs(texture, row_of(seen.albedo, len(pods), size), gain)


def row_of(pixels: FloatArray, count: int, size: int) -> FloatArray:
    """Return K pictures of pixels (K S S, 3) side by side (S, K S, 3)."""
    return np.concatenate(list(pixels.reshape(count, size, size, 3)), axis=1)


def rig_named(name: str) -> Rig:
    """Return the rig of a name."""
    return next(rig for rig in rigs() if rig.name == name)


def truth_uv(sitter: Sitter, pods: FloatArray) -> FloatArray:
    """Return (F, 3, 2) where the pictures show each of the sitter's faces best.

    What no camera shows lies in a corner of the first picture, which is black: its albedo is not compared.
    """
    caster = RayCaster(sitter.vertices, sitter.faces)
    corners = sitter.vertices[sitter.faces]
    normals = face_normals(sitter.vertices, sitter.faces)
    best, uv = np.full(len(corners), _LEAST_COSINE), np.tile([0.0, 1.0], (len(corners), 3, 1))
    for k, (camera, place) in enumerate(zip(pods, camera_centers(pods), strict=True)):
        cosine = np.einsum("ij,ij->i", normals, normalized(place - corners.mean(1)))
        shown = project(camera, corners.reshape(-1, 3))[0].reshape(-1, 3, 2)
        better = (cosine > best) & (np.abs(shown - 0.5) < 0.495).all((1, 2))
        points = np.concatenate([corners[better], corners[better].mean(1, keepdims=True)], 1).reshape(-1, 3)
        view = normalized(place - points)
        hidden = caster.occluded(points + _BEFORE_MM * view, view).reshape(-1, 4).any(1)
        better[better] = ~hidden
        best[better] = cosine[better]
        uv[better] = beside(shown[better], np.full((int(better.sum()), 3), k), len(pods))
    return uv


def build_scan(recipe: ScanRecipe, folder: Path, *, size: int, paths: int, threads: int) -> None:
    """Write NAME.obj, .mtl, .png, NAME_albedo.png, NAME_truth.npz and a preview."""
    sitter = seated(recipe.person, s2a.AnnotatedFaceModel.default())
    tip, rng = nose_tip(sitter.face.vertices), np.random.default_rng([recipe.person.seed, 34 + recipe.take])
    pods = pods_around(tip + CENTER_FROM_NOSE_MM, recipe.cameras)
    measured = capture(
        sitter.vertices,
        sitter.faces,
        pods,
        spacing_mm=SCANNER.spacing_mm,
        rng=rng,
        axis_mm=tip + HEAD_AXIS_FROM_NOSE_MM,
    )
    used = used_pixels(measured, pods, size)
    taken = photographs(recipe, sitter, pods, used, size=size, paths=paths, threads=threads)
    pose = random_pose(rng, recipe.turned_deg)
    scan_from_truth = np.diag([1 / recipe.unit_mm] * 3 + [1.0]) @ pose
    texture = taken.texture.astype(np.float32)
    scan = assembled(measured, pods, texture, scan_from_truth, SCANNER, rng, recipe.name)
    write_truth(recipe, sitter, pods, scan_from_truth, taken.exposure, folder / f"{recipe.name}_truth.npz")
    Image.fromarray(encode_srgb_bytes(taken.albedo)).save(folder / f"{recipe.name}_albedo.png")
    (folder / "look").mkdir(exist_ok=True)
    sheet = np.concatenate([taken.texture, taken.albedo], 0)
    Image.fromarray(encode_srgb_bytes(np.clip(sheet, 0, 1))).save(folder / "look" / f"{recipe.name}.png")
    write_obj(scan, folder / f"{recipe.name}.obj", decimals=4 + int(np.log10(recipe.unit_mm)))


def write_truth(
    recipe: ScanRecipe,
    sitter: Sitter,
    pods: FloatArray,
    scan_from_truth: FloatArray,
    exposure: float,
    file: Path,
) -> None:
    """Write what is known about a scan; `light_directions` (L, 3) are those of all lamps, large ones too."""
    lamps = rig_named(recipe.rig).lamps()
    np.savez_compressed(
        file,
        scan_from_truth=scan_from_truth,
        vertices_mm=sitter.vertices.astype(np.float32),
        faces=sitter.faces.astype(np.int32),
        uv_corners=truth_uv(sitter, pods).astype(np.float32),
        part=sitter.part.astype(np.uint8),
        landmarks68=cKDTree(sitter.face.vertices).query(sitter.face.landmarks)[1].astype(np.int32),
        light_directions=np.array([lamp["direction"] for lamp in lamps]).reshape(-1, 3),
        lights=np.array(json.dumps(lamps)),
        unit_mm=np.array(recipe.unit_mm),
        camera_positions_mm=camera_centers(pods),
        exposure=np.array(exposure),
        description=np.array(rig_named(recipe.rig).description),
        bsdf=np.array(recipe.person.gloss),
    )


__all__ = ["ScanRecipe", "build_scan", "pairs", "recipes"]
