"""Half a ball as a face: people whose skin differs smoothly, and their pictures in everyday light."""

from dataclasses import dataclass

import numpy as np
from worlds.environments import generated_environment

from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import ImageObservation, VertexReflectance
from scan2albedo.reflectance.environment_shading import light_response


@dataclass(frozen=True)
class HalfBall:
    """Points (V, 3) of the unit ball towards the camera at (0, 0, 3), with their normals."""

    points: np.ndarray
    normals: np.ndarray

    @property
    def view(self):
        """(V, 3): unit directions to the camera."""
        return normalized([0, 0, 3.0] - self.points)

    @property
    def seen(self):
        """(V,)."""
        return np.einsum("vi,vi->v", self.normals, self.view) > 0.1

    @classmethod
    def of(cls, directions, bumps=None):
        """Return that half of evenly spread directions; `bumps` (2, 3, 3) are waves that tilt its normals."""
        points = distant_directions(directions)
        points = points[points[:, 2] > 0]
        if bumps is None:
            return cls(points, points)
        waves = [np.sin(points @ wave).sum(1) for wave in bumps]
        return cls(points, normalized(points + 0.25 * np.stack([*waves, np.zeros(len(points))], 1)))

    @property
    def response(self):
        """How its vertices respond to light without shadows."""
        return light_response(self.normals, self.view)

    def people(self, count, seed, pattern=1.0):
        """Return reflectances with eight ways to differ, their albedos times a pattern that all share."""
        shapes = np.random.default_rng(7).normal(size=(5, 8, 81)) @ harmonics(self.points).T * 0.4
        rng, faces = np.random.default_rng(seed), []
        for _ in range(count):
            fields = np.einsum("r,frv->fv", rng.normal(size=8) / np.sqrt(np.arange(1, 9)), shapes)
            diffuse = np.array([0.55, 0.38, 0.30]) * np.exp(0.1 * fields[0, :, None] + 0.03 * fields[1:4].T)
            diffuse = diffuse * np.broadcast_to(pattern, len(self.points))[:, None]
            weights = 0.25 * np.exp(0.1 * fields[4])[:, None] * np.array([0.2, 0.4, 0.4])
            faces.append(VertexReflectance(diffuse, weights, np.ones(len(self.points), bool)))
        return faces

    def picture(
        self,
        face,
        seed,
        *,
        exposure=1.0,
        noise=0.01,
        transfer=None,
    ):
        """Return a face in the light of a generated place, with noise in parts of each colour."""
        light = exposure * project_environment(generated_environment(seed))
        color = (transfer or self.response).shade(face, light).radiance_linear
        color = color * (1 + noise * np.random.default_rng(seed).normal(size=color.shape))
        return ImageObservation(color, self.normals, self.view, self.seen, transfer)

    def albedo_error(self, found, truth):
        """Return the relative error of an albedo (V, 3) after the best scale, where the camera sees it."""
        one, two = found[self.seen], truth.diffuse_linear[self.seen]
        scale = np.sum(one * two) / np.sum(one**2)
        return float(np.linalg.norm(scale * one - two) / np.linalg.norm(two))
