"""Raw scans of painted people, textured with path-traced photographs of two to five cameras; their truth."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import scan2albedo as s2a
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.synthetic.raw_scan import Scanner, assembled, atlas_uv, random_pose
from scan2albedo.synthetic.sitter import BodyPart, Sitter, nose_tip
from worlds.files import write_obj
from worlds.lamps import rig_named
from worlds.path_tracer import LightTable, Studio, exposure_of, stored
from worlds.pictures import (
    BEFORE_MM,
    CENTER_FROM_NOSE_MM,
    filled,
    measured_by,
    pictured,
    pods_around,
    row_of,
    used_pixels,
)
from worlds.sitters import Person, face_part, other_parts, painted, seated

ALBEDO_TEXELS = 1024
"""Rows and columns of the face's albedo."""
SCANNER = Scanner(spacing_mm=2.0, noise_mm=0.15, spikes=8, holes=4, crumbs=4)
_BACKDROP = np.array([0.010, 0.016, 0.030])
"""Linear colour behind the person."""
_LEAST_COSINE = 0.1
"""Faces that a camera sees more obliquely than this take no albedo from its picture."""


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
    """Return the ten scans of the set."""

    def scan(
        name: str,
        rig: str,
        cameras: int,
        tone: float,
        *,
        unit_mm: float = 1.0,
        turned_deg: float = 180.0,
        **features: Any,
    ) -> ScanRecipe:
        person = Person(name=name[:4], seed=int(name[1:4]), tone=tone, **features)
        return ScanRecipe(
            name=name, rig=rig, cameras=cameras, person=person, unit_mm=unit_mm, turned_deg=turned_deg
        )

    return (
        scan("p201_dome", "dome", 3, 0.3, stubble=0.8),
        scan("p202_sky_smile", "sky", 4, 0.15, expression="smile", fringe=0.9),
        scan("p203_softboxes6", "softboxes6", 5, 0.95, gloss="oily"),
        scan("p204_softbox_side", "softbox_side", 2, 0.4, stubble=1.0),
        scan("p205_window_open_m", "window", 3, 0.2, mouth_deg=14.0, fringe=0.8, unit_mm=1000.0),
        scan("p206_ring_coat", "ring", 3, 0.1, gloss="coat", turned_deg=25),
        scan("p207_lamp_room", "lamp_room", 2, 0.55, turned_deg=25),
        scan("p208_flash_oily", "flash_near", 2, 0.7, gloss="oily"),
        scan("p209_flashes2_smile", "flashes2", 4, 0.25, gloss="oily", expression="smile"),
        scan("p210_sun", "sun", 3, 0.45, stubble=0.7, gloss="matte", unit_mm=10.0),
    )


def pairs(heads: Path) -> tuple[ScanRecipe, ...]:
    """Return two scans each, in other light and expression, of people with the skin of every fourth head."""
    lights = (("window", "flash_near"), ("flash_near", "sun"), ("softboxes2", "lamp_room"), ("sun", "window"))
    made = []
    for k, (head, rigs) in enumerate(zip(sorted(heads.glob("*.obj"))[1::4], lights, strict=False)):
        one = Person(name=f"q{k}", seed=301 + k, tone=0.4, skin=head)
        other = replace(one, expression="smile" if k % 2 else "frown", mouth_deg=0.0 if k % 2 else 8.0)
        for take, (person, rig) in enumerate(zip((one, other), rigs, strict=True)):
            name = f"{one.name}_{rig}"
            made.append(ScanRecipe(name=name, rig=rig, cameras=3 - take, person=person, take=10 * take))
    return tuple(made)


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
    person, seen = recipe.person, pictured(sitter.vertices, sitter.faces, pods, size)
    face, barycentric = seen.face[seen.hit], seen.barycentric[seen.hit]
    shown = sitter.albedo_at(face, barycentric)
    on_face = sitter.part[face] == BodyPart.FACE
    uv = np.einsum("nk,nkc->nc", barycentric[on_face], sitter.corner_uv[face[on_face]])
    shown[on_face] = painted(person, sitter, uv)
    albedo = np.zeros(seen.position.shape)
    albedo[seen.hit] = shown

    used = used & seen.hit
    parts = [face_part(person, sitter, ALBEDO_TEXELS), *other_parts(person, sitter, size=1536)]
    studio = Studio(parts, nearest=False, threads=threads)
    table = LightTable(studio, *seen.before(used), paths, 1000 * person.seed)
    radiance = table.under(rig_named(recipe.rig))
    gain = exposure_of(radiance[sitter.part[seen.face[used]] <= BodyPart.HEAD])
    light = np.zeros_like(albedo)
    light[used] = gain * radiance / np.maximum(albedo[used], 1e-3)
    picture = albedo * filled(light, used, len(pods), size).reshape(-1, 3)
    picture[used] = gain * radiance
    picture[~seen.hit] = _BACKDROP
    rng = np.random.default_rng([person.seed, 33 + recipe.take])
    texture = row_of(stored(picture, rng), len(pods), size)
    return Photographs(texture, row_of(albedo, len(pods), size), gain)


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
        hidden = caster.occluded(points + BEFORE_MM * view, view).reshape(-1, 4).any(1)
        better[better] = ~hidden
        best[better] = cosine[better]
        uv[better] = atlas_uv(shown[better], np.full((int(better.sum()), 3), k), len(pods))
    return uv


def build_scan(recipe: ScanRecipe, folder: Path, *, size: int, paths: int, threads: int) -> None:
    """Write NAME.obj, .mtl, .png, NAME_albedo.png and NAME_truth.npz.

    Of the truth, `light_directions` (L, 3) are those of all lamps, large ones too.
    """
    sitter = seated(recipe.person, s2a.AnnotatedFaceModel.default())
    tip, rng = nose_tip(sitter.face.vertices), np.random.default_rng([recipe.person.seed, 34 + recipe.take])
    pods = pods_around(tip + CENTER_FROM_NOSE_MM, recipe.cameras)
    measured = measured_by(pods, sitter.vertices, sitter.faces, tip, SCANNER, rng)
    used = used_pixels(measured, pods, size)
    taken = photographs(recipe, sitter, pods, used, size=size, paths=paths, threads=threads)
    pose = random_pose(rng, recipe.turned_deg)
    scan_from_truth = np.diag([1 / recipe.unit_mm] * 3 + [1.0]) @ pose
    texture = taken.texture.astype(np.float32)
    scan = assembled(measured, pods, texture, scan_from_truth, SCANNER, rng, recipe.name)
    lamps = rig_named(recipe.rig).lamps()
    np.savez_compressed(
        folder / f"{recipe.name}_truth.npz",
        scan_from_truth=scan_from_truth,
        vertices_mm=sitter.vertices.astype(np.float32),
        faces=sitter.faces.astype(np.int32),
        uv_corners=truth_uv(sitter, pods).astype(np.float32),
        light_directions=np.array([lamp["direction"] for lamp in lamps]).reshape(-1, 3),
        lights=np.array(json.dumps(lamps)),
        unit_mm=np.array(recipe.unit_mm),
        camera_positions_mm=camera_centers(pods),
        exposure=np.array(taken.exposure),
    )
    Image.fromarray(encode_srgb_bytes(taken.albedo)).save(folder / f"{recipe.name}_albedo.png")
    write_obj(scan, folder / f"{recipe.name}.obj", decimals=4 + int(np.log10(recipe.unit_mm)))
