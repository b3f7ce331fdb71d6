"""Path-traced geometry images of sitters with exact shape, and their truth: soft_*.npz, geometry_*.npz."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

import scan2albedo as s2a
from benchmarks.traced_bake import (
    ABOVE_MM,
    LightTable,
    Studio,
    best_views,
    camera_positions,
    exposure_of,
    stored,
)
from benchmarks.traced_lights import Rig
from benchmarks.traced_people import Person, bare_skin, face_part, other_parts, seated
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.synthetic.face_shape import face_geometry_image
from scan2albedo.synthetic.scenes import texel_coordinates

CAMERAS_DEG = [(0.0, 0.0), (-50.0, 5.0), (50.0, 5.0), (0.0, -35.0)]
"""Azimuth and elevation; the first one is preferred."""
CAMERA_MM = 1200.0


class ImageSet:
    """The geometry images of one person, under any rig."""

    def __init__(self, person: Person, *, size: int, paths: int, threads: int) -> None:
        self.person, model = person, s2a.AnnotatedFaceModel.default()
        self.sitter = seated(person, model)
        self.image = face_geometry_image(model, self.sitter.face, size)
        face = face_part(person, self.sitter, size)
        self.albedo = face.albedo
        mask = self.image.mask
        position, normal = self.image.position[mask], self.image.normal[mask]
        cameras = camera_positions(CAMERAS_DEG, CAMERA_MM, position.mean(0))
        caster = RayCaster(self.sitter.vertices, self.sitter.faces)
        self.seen = best_views(position, normal, caster, cameras)
        studio = Studio([face, *other_parts(person, self.sitter)], nearest=True, threads=threads)
        shown, toward = self.seen.any, self.seen.toward
        start = (position + ABOVE_MM * toward)[shown]
        self._table = LightTable(studio, start, -toward[shown], paths, 1000 * person.seed)

    def write_geometry(self, folder: Path) -> None:
        """Write geometry_PERSON.npz: the exact shape and all that casts shadows."""
        image, mask = self.image, self.image.mask
        uv = texel_coordinates(len(mask))[mask.ravel()]
        skin = np.zeros_like(mask)
        skin[mask] = bare_skin(self.person, self.sitter, uv, self.albedo[mask].astype(np.float64))
        assert image.region is not None
        np.savez_compressed(
            folder / f"geometry_{self.person.name}.npz",
            position_mm=image.position.astype(np.float32),
            normal=image.normal.astype(np.float32),
            mask=mask,
            region=image.region,
            skin=skin,
            landmarks68_mm=self.sitter.face.landmarks,
            occluder_vertices=self.sitter.vertices.astype(np.float32),
            occluder_faces=self.sitter.faces.astype(np.uint32),
        )

    def write(self, rig: Rig, folder: Path) -> None:
        """Write soft_LIGHT_PERSON.npz and its preview."""
        radiance = self._table.under(rig)
        gain = exposure_of(radiance)
        mask = self.image.mask.copy()
        mask[mask] = self.seen.any
        clean = self._on_grid(mask, gain * radiance)
        rng = np.random.default_rng([self.person.seed, len(rig.name), sum(map(ord, rig.name))])
        picture = np.where(mask[..., None], stored(clean, rng), 0)
        albedo = np.where(mask[..., None], self.albedo, 0)
        camera, view = np.full(self.image.mask.shape, -1, np.int8), np.zeros((*mask.shape, 3), np.float16)
        camera[self.image.mask], view[self.image.mask] = self.seen.camera, self.seen.toward
        name = f"soft_{rig.name}_{self.person.name}"
        np.savez_compressed(
            folder / f"{name}.npz",
            texture_linear=clean.astype(np.float32),
            texture_srgb8=encode_srgb_bytes(picture),
            albedo_linear=albedo.astype(np.float16),
            mask=mask,
            geometry=self.person.name,
            view_direction=np.array([0, 0, 1], np.float32),
            camera=camera,
            view_direction_texel=view,
            lights=json.dumps(rig.lamps()),
            ambient=json.dumps(rig.description),
            description=rig.description,
            bsdf=json.dumps(self.person.gloss),
            exposure=gain,
        )
        save_preview(folder / "look" / f"{name}.png", [picture, albedo, ratio(clean, albedo, mask)])

    @staticmethod
    def _on_grid(mask: BoolArray, values: FloatArray) -> FloatArray:
        grid = np.zeros((*mask.shape, 3))
        grid[mask] = values
        return grid


def ratio(picture: FloatArray, albedo: FloatArray, mask: BoolArray) -> FloatArray:
    """Return the light: picture on albedo, scaled to show."""
    light = np.where(mask[..., None], picture / np.maximum(albedo, 1e-3), 0)
    return light / np.quantile(light[mask], 0.98)


def save_preview(path: Path, panels: list[FloatArray]) -> None:
    """Write linear pictures side by side as one PNG."""
    path.parent.mkdir(exist_ok=True)
    row = np.concatenate([np.clip(panel, 0, 1) for panel in panels], 1)
    Image.fromarray(encode_srgb_bytes(row)).save(path)
