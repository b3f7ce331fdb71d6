"""`LightingModel`: what light in everyday places is like, as a mean and directions of change."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.environment_harmonics import project_environment, row_projection
from scan2albedo.reflectance.environment_shading import HARMONICS
from scan2albedo.reflectance.generated_environments import SHAPE, generated_environment
from scan2albedo.reflectance.sample_statistics import sample_eigenvectors

FloatArray = NDArray[np.float64]

COMPONENTS = 80
_WHITE = np.sqrt(4 * np.pi)
"""First coefficient of light whose mean radiance is 1."""


@dataclass(frozen=True)
class LightingModel:
    """Light L = scale_rgb * (mean + sum g_i basis_i), g of unit variance.

    Every map is divided by its mean radiance channel by channel, so scale_rgb is that mean radiance and the
    directions hold only how light is spread: brightness and white balance have one place, not two.

    This is a prior for fits rather than a source of light: lamps are rare and strong, and coefficients drawn
    from a normal distribution make places that are darker than dark.

    Parameters
    ----------
    mean : (81, 3) float64
        Coefficients of harmonics; sqrt(4 pi) comes first.
    basis : (N, 81, 3) float64
        The first coefficient of each is 0.
    deviation : (N,) float64
        Standard deviation along each direction, largest first.
    total_variance : float
        Of the maps' coefficients, all directions together.
    """

    mean: FloatArray
    basis: FloatArray
    deviation: FloatArray
    total_variance: float

    @classmethod
    def default(cls) -> LightingModel:
        """Return the model of 600 generated maps; made once a process, in about a second."""
        return _default()

    @classmethod
    def generate(cls, *, count: int = 600, components: int = COMPONENTS, seed: int = 0) -> LightingModel:
        """Learn a model from `count` maps that `generated_environment` draws; the same seed, the same model.

        Parameters
        ----------
        count : int
            2 or more.
        components : int
            Directions to keep.
        seed : int

        Raises
        ------
        ReflectanceError
            When `count` is 1 or less, which has no directions.
        """
        if count < 2:
            raise ReflectanceError(
                f"{count} environment maps tell nothing of how light varies; give 2 or more"
            )
        rng = np.random.default_rng(seed)
        projection = _projection()
        maps = (generated_environment(rng).reshape(-1, 3) for _ in range(count))
        return cls.from_coefficients(np.stack([projection @ image for image in maps]), components=components)

    @classmethod
    def from_environments(
        cls, environments_linear: ArrayLike, *, components: int = COMPONENTS
    ) -> LightingModel:
        """Learn a model from maps (K, H, W, 3) of your own.

        Raises
        ------
        ReflectanceError, ValueError
            As `from_coefficients` does, and for maps of another shape.
        """
        maps = np.asarray(environments_linear, np.float64)
        if maps.ndim != 4:
            raise ValueError(f"environments_linear must have shape (K, H, W, 3), got {maps.shape}")
        return cls.from_coefficients(project_environment(maps), components=components)

    @classmethod
    def from_coefficients(cls, lights: ArrayLike, *, components: int = COMPONENTS) -> LightingModel:
        """Learn a model from coefficients (K, 81, 3) of light.

        Raises
        ------
        ReflectanceError
            When a light is not finite, or a channel of it has no light.
        ValueError
            For another shape.
        """
        samples = _checked_lights(lights)
        spread = samples * (_WHITE / samples[:, :1])
        off = spread - spread.mean(0)
        off[:, 0] = 0.0
        vectors, deviation, variance = sample_eigenvectors(off, components, size=float(np.sum(spread**2)))
        basis = np.tensordot(vectors.T / np.sqrt(max(len(samples) - 1, 1)), off, 1)
        return cls(spread.mean(0), basis, deviation, variance)

    @property
    def components(self) -> int:
        """N, the number of coefficients."""
        return len(self.deviation)

    @property
    def explained(self) -> FloatArray:
        """(N,) shares of the variance that the directions hold one by one."""
        return self.deviation**2 / max(self.total_variance, 1e-300)

    def light(self, coefficients: ArrayLike, *, scale_rgb: ArrayLike = (1.0, 1.0, 1.0)) -> FloatArray:
        """Return coefficients (81, 3) of light with mean radiance `scale_rgb` (3,).

        Raises
        ------
        ReflectanceError
            When a number is not finite.
        ValueError
            For another shape.

        Examples
        --------
        >>> model = LightingModel.generate(count=10)
        >>> light = model.light(np.zeros(9), scale_rgb=[1.0, 2.0, 3.0])
        >>> (light[0] / np.sqrt(4 * np.pi)).round(6).tolist()
        [1.0, 2.0, 3.0]
        """
        gamma, scale = np.asarray(coefficients, np.float64), np.asarray(scale_rgb, np.float64)
        if gamma.shape != (self.components,) or scale.shape != (3,):
            raise ValueError(
                f"coefficients and scale_rgb must have shapes ({self.components},) and (3,), got "
                f"{gamma.shape} and {scale.shape}"
            )
        if not (np.isfinite(gamma).all() and np.isfinite(scale).all()):
            raise ReflectanceError("coefficients of light hold NaN or infinite values; give finite ones")
        return scale * (self.mean + np.tensordot(gamma, self.basis, 1))

    def project(self, light: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return coefficients (N,) and scale_rgb (3,) of the model's light nearest to one (81, 3).

        Raises
        ------
        ReflectanceError
            When it is not finite, or a channel has no light.
        ValueError
            For another shape.
        """
        target = _checked_lights(np.asarray(light, np.float64)[None])[0]
        off = target * (_WHITE / target[0]) - self.mean
        flat = self.basis.reshape(self.components, HARMONICS * 3)
        return flat @ off.ravel() / self.deviation**2, target[0] / _WHITE


def _checked_lights(lights: ArrayLike) -> FloatArray:
    samples = np.asarray(lights, np.float64)
    if samples.ndim != 3 or samples.shape[1:] != (HARMONICS, 3) or len(samples) == 0:
        raise ValueError(f"lights must have shape (K, {HARMONICS}, 3), got {samples.shape}")
    bad = ~(np.isfinite(samples).all((1, 2)) & (samples[:, 0] > 0).all(1))
    if bad.any():
        raise ReflectanceError(
            f"light {int(np.flatnonzero(bad)[0])} has NaN or a channel without light; leave it out"
        )
    return samples


@cache
def _default() -> LightingModel:
    return LightingModel.generate()


@cache
def _projection() -> FloatArray:
    """(81, H W) projection of generated maps."""
    return np.concatenate([row_projection(row, SHAPE) for row in range(SHAPE[0])]).T
