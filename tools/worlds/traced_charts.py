"""Path-traced geometry images of painted people with exact shape: soft_*.npz, geometry_*.npz."""

import json
from pathlib import Path

import numpy as np

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.synthetic.face_shape import face_geometry_image
from scan2albedo.synthetic.renderer import toward
from worlds.lamps import Rig
from worlds.path_tracer import LightTable, Studio, exposure_of, stored
from worlds.pictures import BEFORE_MM
from worlds.sitters import Person, face_part, other_parts, seated

CAMERAS_DEG = [(0.0, 0.0), (-50.0, 5.0), (50.0, 5.0), (0.0, -35.0)]
"""Azimuth and elevation; the first one is preferred."""
CAMERA_MM = 1200.0
"""Distance of the cameras from the middle of the face."""
PEOPLE = (
    Person(name="anna", seed=3, tone=0.12, fringe=0.9, gloss="skin"),
    Person(name="ben", seed=8, tone=0.9, stubble=0.9, mouth_deg=13.0, gloss="oily"),
)
_GRAZING = 0.15
"""Least cosine between a camera's view and the normal."""
_FRONT_LEAD = 0.4
"""The first camera is preferred by this much of the cosine."""


def best_views(
    points: FloatArray, normals: FloatArray, caster: RayCaster, cameras: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return which camera (N,) sees each point best, -1 for none, and the unit direction (N, 3) toward it.

    The best one has the largest cosine among those that nothing hides.
    """
    score, chosen = np.full(len(points), _GRAZING), np.full(len(points), -1)
    direction = np.zeros_like(points)
    for k, camera in enumerate(cameras):
        view = normalized(camera - points)
        cosine = np.einsum("ij,ij->i", normals, view)
        lead = _FRONT_LEAD if k == 0 else 0.0
        better = (cosine > _GRAZING) & (cosine + lead > score)
        better[better] = ~caster.occluded((points + BEFORE_MM * view)[better], view[better])
        score[better], chosen[better], direction[better] = cosine[better] + lead, k, view[better]
    return chosen, direction


class ChartSet:
    """The geometry images of one person, under any rig."""

    def __init__(self, person: Person, *, size: int, paths: int, threads: int) -> None:
        self.person, model = person, s2a.AnnotatedFaceModel.default()
        self.sitter = seated(person, model)
        self.image = face_geometry_image(model, self.sitter.face, size)
        face = face_part(person, self.sitter, size)
        self.albedo = face.albedo
        mask = self.image.mask
        position, normal = self.image.position[mask], self.image.normal[mask]
        cameras = np.array([position.mean(0) + CAMERA_MM * toward(*pair) for pair in CAMERAS_DEG])
        caster = RayCaster(self.sitter.vertices, self.sitter.faces)
        camera, direction = best_views(position, normal, caster, cameras)
        shown = camera >= 0
        self.shown = mask.copy()
        self.shown[mask] = shown
        studio = Studio([face, *other_parts(person, self.sitter)], nearest=True, threads=threads)
        start = (position + BEFORE_MM * direction)[shown]
        self._table = LightTable(studio, start, -direction[shown], paths, 1000 * person.seed)

    def write_geometry(self, folder: Path) -> None:
        """Write geometry_PERSON.npz: the exact shape and all that casts shadows."""
        np.savez_compressed(
            folder / f"geometry_{self.person.name}.npz",
            position_mm=self.image.position.astype(np.float32),
            normal=self.image.normal.astype(np.float32),
            mask=self.image.mask,
            occluder_vertices=self.sitter.vertices.astype(np.float32),
            occluder_faces=self.sitter.faces.astype(np.uint32),
        )

    def write(self, rig: Rig, folder: Path) -> None:
        """Write soft_LIGHT_PERSON.npz: picture, albedo and lamps."""
        radiance = self._table.under(rig)
        gain, shown = exposure_of(radiance), self.shown
        clean = np.zeros((*shown.shape, 3))
        clean[shown] = gain * radiance
        rng = np.random.default_rng([self.person.seed, len(rig.name), sum(map(ord, rig.name))])
        picture = np.where(shown[..., None], stored(clean, rng), 0)
        np.savez_compressed(
            folder / f"soft_{rig.name}_{self.person.name}.npz",
            texture_srgb8=encode_srgb_bytes(picture),
            albedo_linear=np.where(shown[..., None], self.albedo, 0).astype(np.float16),
            mask=shown,
            geometry=self.person.name,
            lights=json.dumps(rig.lamps()),
            exposure=gain,
        )
