"""Environment maps as sums of distant lights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import normalized

_FINEST_ROWS = 256
"""Texels of coarser maps are cut up to this many rows, so that cells of many lights keep their share."""


@dataclass(frozen=True)
class DistantLights:
    """Lights far away: each has one direction for the whole scene."""

    directions: ArrayLike
    """(K, 3): towards the lights, of any length."""
    irradiance_linear: ArrayLike
    """(K, 3) or (K,): on a surface that faces the light; a matte white one then has the radiance irradiance /
    pi."""

    def __post_init__(self) -> None:
        toward = _checked_directions(self.directions)
        irradiance = np.asarray(self.irradiance_linear, np.float64)
        if irradiance.shape not in ((len(toward),), (len(toward), 3)):
            raise ValueError(
                f"irradiance_linear must be ({len(toward)}, 3) or ({len(toward)},), got {irradiance.shape}"
            )
        if not np.isfinite(irradiance).all():
            raise ValueError("irradiance_linear must be finite")
        object.__setattr__(self, "directions", toward)
        rgb = irradiance if irradiance.ndim == 2 else np.repeat(irradiance[:, None], 3, 1)
        object.__setattr__(self, "irradiance_linear", rgb)

    @classmethod
    def from_environment(cls, environment_linear: ArrayLike, count: int = 64) -> DistantLights:
        """Return `count` lights spread evenly that together shine like an environment map (H, W, 3)."""
        directions = distant_directions(count)
        return cls(directions, environment_weights(environment_linear, directions))


def distant_directions(count: int) -> FloatArray:
    """Return (K, 3) unit vectors spread evenly over the sphere, a Fibonacci spiral from +y down.

    Parameters
    ----------
    count : int
        K, 1 or more.

    Raises
    ------
    ValueError
        When `count` is below 1.

    Examples
    --------
    >>> directions = distant_directions(100)
    >>> bool(abs(directions.mean(0)).max() < 0.01)
    True
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    step = np.arange(count)
    y, azimuth = 1 - (2 * step + 1) / count, step * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - y * y)
    return np.stack([across * np.sin(azimuth), y, across * np.cos(azimuth)], 1)


def environment_weights(environment_linear: ArrayLike, directions: ArrayLike) -> FloatArray:
    """Return (K, 3) integrals of an environment map over each direction's cell of the sphere.

        w_k = integral of L over the directions that are nearer to k than to all others.

    The cells part the sphere, texels being constant, so the weights sum to the map's integral and are linear
    in it.

    Parameters
    ----------
    environment_linear : (H, W, 3) array_like of float
        Radiance; rows from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    directions : (K, 3) array_like of float
        Of any length but zero.

    Raises
    ------
    ValueError
        When an array has the wrong shape, is empty or not finite.

    Notes
    -----
    Cost: one nearest-neighbour search a texel.

    References
    ----------
    .. [1] J. Li et al., "MEGANE: Morphable Eyeglass and Avatar Network", CVPR 2023, supplement, section 6.3.

    Examples
    --------
    >>> weights = environment_weights(np.ones((8, 16, 3)), [[0, 1, 0], [0, -1, 0]])
    >>> weights.round(4).tolist() == [[6.2832] * 3] * 2
    True
    """
    image = _checked_map(environment_linear)
    return map_cells(_checked_directions(directions), image.shape[:2]).weights(image)


@dataclass(frozen=True)
class MapCells:
    """Shares of a map's texels in the cells of directions, which serve any map of one size."""

    shares: sparse.csr_matrix
    """(K, H W) solid angles."""

    def weights(self, environment_linear: FloatArray) -> FloatArray:
        """Return (K, 3) integrals of a map (H, W, 3)."""
        return np.asarray(self.shares @ environment_linear.reshape(-1, 3))


def map_cells(directions: FloatArray, shape: tuple[int, int]) -> MapCells:
    """Return the cells of unit directions (K, 3) in maps of a shape (H, W)."""
    tree, (height, width) = cKDTree(directions), shape
    repeat = max(1, -(-_FINEST_ROWS // height))
    rows, columns = height * repeat, width * repeat
    azimuth = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    solid_angle = (edges[:-1] - edges[1:]) * 2 * np.pi / columns
    nearest = np.empty((rows, columns), np.int32)
    for row, polar in enumerate((np.arange(rows) + 0.5) * np.pi / rows):
        y = np.full(columns, np.cos(polar))
        toward = np.stack([np.sin(polar) * np.sin(azimuth), y, np.sin(polar) * np.cos(azimuth)], 1)
        nearest[row] = tree.query(toward)[1]
    texel = np.add.outer(
        np.arange(rows, dtype=np.int32) // repeat * width, np.arange(columns, dtype=np.int32) // repeat
    )
    # Texels are gathered before their colour enters, so that weights stay exactly linear in the map.
    entries = np.repeat(solid_angle, columns), (nearest.ravel(), texel.ravel())
    return MapCells(sparse.coo_matrix(entries, shape=(tree.n, height * width)).tocsr())


def _checked_map(environment_linear: ArrayLike) -> FloatArray:
    image = np.asarray(environment_linear, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"environment_linear must have shape (H, W, 3), got {image.shape}")
    if not np.isfinite(image).all():
        raise ValueError("environment_linear must be finite")
    return image


def _checked_directions(directions: ArrayLike) -> FloatArray:
    toward = np.asarray(directions, np.float64)
    if toward.ndim != 2 or toward.shape[1] != 3 or len(toward) == 0:
        raise ValueError(f"directions must have shape (K, 3), got {toward.shape}")
    unit = normalized(toward)
    if not (np.isfinite(unit).all() and unit.any(1).all()):
        raise ValueError("directions must be finite and not zero")
    return unit
