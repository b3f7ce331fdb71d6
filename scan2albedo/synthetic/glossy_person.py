"""Synthetic people whose skin reflects as three Blinn-Phong lobes over Lambert, and how flashes light it.

The radiance is computed here without `reflectance`, so that its fits are tested against independent code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, dots, norms
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.geometry.pinhole import pixel_directions, pixel_grid
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.synthetic.face_shape import FaceSurface, face_surface, person as sculpted
from scan2albedo.synthetic.renderer import SHADOW_OFFSET_MM, RayScene
from scan2albedo.synthetic.sitter import BodyPart, Sitter, sit_down
from scan2albedo.synthetic.textures import LOOKS, PaintedFeatures, drawn, paint_face, smooth_noise

EXPONENTS = (1, 8, 64)


@dataclass(frozen=True)
class SeenSurface:
    """N surface points that a picture shows; arrays are (N, 3), positions in mm.

    `mask` (S, S) are their pixels, `on_face` (N,) marks the face.
    """

    mask: BoolArray
    position: FloatArray
    normal: FloatArray
    toward_camera: FloatArray
    diffuse_linear: FloatArray
    weights: FloatArray
    on_face: BoolArray


@dataclass(frozen=True)
class GlossyPerson:
    """A sitter with `diffuse_linear` and lobe `weights` (V, 3) at the face's vertices, linear between them.

    `shown` (F,) are the sitter's faces in the picture (hair may be left out); `scene` is made of these.
    """

    sitter: Sitter
    diffuse_linear: FloatArray
    weights: FloatArray
    shown: IntArray
    scene: RayScene

    @classmethod
    def seated(cls, seed: int, hair: bool, levels: int) -> GlossyPerson:
        """Return a random person; ValueError when `levels` of subdivision are not 1, 2 or 3."""
        if levels not in (1, 2, 3):
            raise ValueError(f"levels is {levels}, expected 1, 2 or 3")
        sitter = sit_down(seed, expression="neutral", model=default_model())
        shown = np.flatnonzero(hair | (sitter.part != BodyPart.HAIR))
        weights = gloss_weights(sitter.face, sitter.model, sitter.seed)
        scene = RayScene(sitter.vertices, sitter.faces[shown])
        return cls(sitter, sitter.face_albedo(sitter.face.uv), weights, shown, scene)

    def seen(self, camera: FloatArray, center: FloatArray, size: int) -> SeenSurface:
        """Return what a camera (3, 4) at `center` (3,) sees in a picture of `size` x `size` pixels."""
        rays = pixel_directions(camera, pixel_grid((size, size)))
        hits = self.scene.first_hit(np.broadcast_to(center, rays.shape), rays)
        seen = hits.face >= 0
        face, barycentric = self.shown[hits.face[seen]], hits.barycentric[seen]
        corners, on_face = self.sitter.faces[face], self.sitter.part[face] == BodyPart.FACE
        # On the face albedo and weights are linear between vertices; other parts have one shine each.
        diffuse, weights = np.empty((len(face), 3)), np.empty((len(face), 3))
        for array, values in ((diffuse, self.diffuse_linear), (weights, self.weights)):
            array[on_face] = np.einsum("nk,nkc->nc", barycentric[on_face], values[corners[on_face]])
        other = ~on_face
        diffuse[other] = self.sitter.albedo_at(face[other], barycentric[other])
        shine = LOOKS["shine"][self.sitter.part[face[other]]]
        weights[other] = shine[:, None] * self.weights.mean(0)
        surface = *self.sitter.points_at(face, barycentric), -rays[seen], diffuse, weights, on_face
        return SeenSurface(seen.reshape(size, size), *surface)

    def radiance_under(
        self, seen: SeenSurface, light: FloatArray, *, reference_distance_mm: float | None = None
    ) -> FloatArray:
        """Return the radiance (N, 3) under a light of unit strength at `light` (3,), with cast shadows.

        V (c / pi max(0, n.l) + sum_k w_k (s_k + 2) / (8 pi) max(0, n.h)^s_k), falling off with the square of
        the distance to 1 at `reference_distance_mm`, if that is given.
        """
        offset = light - seen.position
        reach = norms(offset)
        radiance = self._reflected(seen, offset / reach[:, None], reach)
        if reference_distance_mm is None:
            return radiance
        return radiance * (reference_distance_mm / reach[:, None]) ** 2

    def under(self, seen: SeenSurface, lights: DistantLights) -> FloatArray:
        """Return the radiance (N, 3) under distant lights, with cast shadows."""
        radiance = np.zeros((len(seen.position), 3))
        everywhere = np.full(len(radiance), np.inf)
        for direction, irradiance in zip(
            np.asarray(lights.directions), np.asarray(lights.irradiance_linear), strict=True
        ):
            toward = np.broadcast_to(direction, seen.position.shape)
            radiance += irradiance * self._reflected(seen, toward, everywhere)
        return radiance

    def _reflected(self, seen: SeenSurface, toward: FloatArray, reach: FloatArray) -> FloatArray:
        """Return radiance (N, 3) under light of strength 1 from directions (N, 3), `reach` (N,) mm away."""
        n_l = dots(seen.normal, toward)
        facing = np.flatnonzero(n_l > 0)
        start = seen.position[facing] + SHADOW_OFFSET_MM * seen.normal[facing]
        rows = facing[~self.scene.occluded(start, toward[facing], reach[facing])]
        half = normalized(toward[rows] + seen.toward_camera[rows])
        n_h = np.maximum(dots(seen.normal[rows], half), 0.0)
        gloss = np.zeros(len(rows))
        for k, s in enumerate(EXPONENTS):
            gloss += seen.weights[rows, k] * (s + 2) / (8 * np.pi) * n_h**s
        radiance = np.zeros((len(reach), 3))
        radiance[rows] = seen.diffuse_linear[rows] / np.pi * n_l[rows, None] + gloss[:, None]
        return radiance


def gloss_weights(face: FaceSurface, model: AnnotatedSurface, seed: int) -> FloatArray:
    """Return (V, 3): the person's own means, patches of more and less shine, more on lips and nose."""
    rng = np.random.default_rng([seed, 20])
    # Sums are about twice what skin reflects at normal incidence (0.028), as oily skin.
    mean = LOOKS["lobe_mean"] + LOOKS["lobe_deviation"] * np.clip(rng.standard_normal(3), -2, 2)
    patches = np.exp(0.25 * np.stack([smooth_noise(face.uv, (6, 6), rng) for _ in EXPONENTS], axis=1))
    scale = vertex_average(len(face.uv), face.faces, model.region_values("specular_scale")[face.region])
    return mean * patches * scale[:, None]


@dataclass(frozen=True)
class GlossyFace:
    """A face and its reflectance, in the frame of the face model, mm."""

    vertices: FloatArray
    normals: FloatArray
    """`vertices`, `normals`: (V, 3)."""
    faces: IntArray
    """(F, 3)."""
    landmarks: FloatArray
    """(68, 3)."""
    diffuse_linear: FloatArray
    weights: FloatArray
    """`diffuse_linear`, `weights`: (V, 3): true albedo, and true weights of the Blinn-Phong lobes with
    exponents 1, 8 and 64."""

    @classmethod
    def from_person(cls, person: GlossyPerson, levels: int) -> GlossyFace:
        """Return the face of a person after `levels` of subdivision."""
        sitter = person.sitter
        subdivision = sitter.model.subdivision(levels)
        # Vertices of coarser levels are the first ones of finer levels.
        count = subdivision.matrix.shape[0]
        face = sitter.face.vertices[:count], sitter.normals[:count], subdivision.faces, sitter.face.landmarks
        return GlossyFace(*face, person.diffuse_linear[:count], person.weights[:count])


@dataclass(frozen=True)
class Individual:
    """A person: seeds of shape and paint, the skin's tone (0 lightest ... 1 darkest), brows and lips."""

    shape_seed: int
    tone: float
    features: PaintedFeatures
    paint_seed: int

    @classmethod
    def drawn(cls, rng: np.random.Generator, tones: tuple[float, float] = (0.0, 1.0)) -> Individual:
        """Return a random person with a tone in the range."""
        shape_seed, tone = int(rng.integers(2**31)), float(rng.uniform(*tones))
        # A third more or less hair, brows and lips moved by about a millimetre: what relatives differ by.
        features = PaintedFeatures(**drawn("features", rng))
        return cls(shape_seed, tone, features, int(rng.integers(2**31)))

    def albedo(self, uv: FloatArray, model: AnnotatedSurface) -> FloatArray:
        """Return linear albedo (N, 3) at coordinates (N, 2) of the model's chart."""
        rng = np.random.default_rng(self.paint_seed)
        return paint_face(uv, model, rng, tone=self.tone, features=self.features)


def population_reflectance(person: int, levels: int = 1) -> GlossyFace:
    """Return the true reflectance of a `person`, 0 and so on, at rest, without relief and any photograph.

    The lobes are drawn as for `flash_capture`. Vertices of all people correspond: those of the default
    model's surface after `levels` refinements.
    """
    template = default_model()
    individual = Individual.drawn(np.random.default_rng([0, person, 11]))
    points = sculpted(template, np.random.default_rng([individual.shape_seed, 2]))
    face = face_surface(template, points, levels=levels)
    weights = gloss_weights(face, template, individual.shape_seed)
    albedo = individual.albedo(face.uv, template)
    return GlossyFace(face.vertices, face.normals, face.faces, face.landmarks, albedo, weights)
