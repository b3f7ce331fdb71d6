"""People of a population: shape, skin, brows and lips that stay theirs from scan to scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.synthetic.face_paint import PaintedFeatures, paint_face
from scan2albedo.synthetic.face_shape import face_surface
from scan2albedo.synthetic.face_shape import person as sculpted
from scan2albedo.synthetic.glossy_person import GlossyFace, gloss_weights


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
        features = PaintedFeatures(
            brow_thickness=float(rng.uniform(0.65, 1.35)),
            brow_lift=float(rng.uniform(-0.006, 0.006)),
            brow_arch=float(rng.uniform(-0.003, 0.008)),
            brow_reach=float(rng.uniform(0.75, 1.1)),
            lip_fullness=float(rng.uniform(-0.004, 0.004)),
        )
        return cls(shape_seed, tone, features, int(rng.integers(2**31)))

    def albedo(self, uv: FloatArray, model: AnnotatedSurface) -> FloatArray:
        """Return linear albedo (N, 3) at coordinates (N, 2) of the model's chart."""
        rng = np.random.default_rng(self.paint_seed)
        return paint_face(uv, model, rng, tone=self.tone, features=self.features)


def population_reflectance(
    person: int, *, seed: int = 0, levels: int = 1, model: AnnotatedSurface | None = None
) -> GlossyFace:
    """Return the true reflectance of a person at rest, without fine relief and without any photograph.

    The lobes are drawn as for `flash_capture`. Vertices of all people correspond.

    Parameters
    ----------
    person, seed : int
        Number of the person, from 0, and seed of the population.
    levels : int
        Refinements of the model's surface.
    model : AnnotatedSurface, optional
        The default model when omitted; it needs landmarks.
    """
    template = model or default_model()
    individual = Individual.drawn(np.random.default_rng([seed, person, 11]))
    points = sculpted(template, np.random.default_rng([individual.shape_seed, 2]))
    face = face_surface(template, points, levels=levels)
    uv = face.vertex_uv()
    weights = gloss_weights(face, template, uv, individual.shape_seed)
    albedo = individual.albedo(uv, template)
    return GlossyFace(face.vertices, face.normals, face.faces, face.landmarks, albedo, weights)
