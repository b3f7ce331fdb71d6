"""Environment maps as sums of distant lights."""

from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import ArrayLike, FloatArray, GridShape, checked_array, norms
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rasterization import area_mean

LightSpread = Literal["important", "even"]

_EVEN_SHARE = 0.1
"""Part of `important_directions` that does not follow the light."""
_FINEST_ROWS = 256
"""Texels of coarser maps are cut up to this many rows, so that cells of many lights keep their share."""


@dataclass(frozen=True)
class DistantLights:
    """Lights far away: each has one direction for the whole scene.

    `directions` (K, 3) toward them are of any length; `irradiance_linear` (K, 3) or (K,) is that on a surface
    that faces the light: a matte white one has 1 / pi of it as radiance.
    """

    directions: ArrayLike
    irradiance_linear: ArrayLike

    def __post_init__(self) -> None:
        toward, irradiance = _checked_directions(self.directions), np.asarray(self.irradiance_linear, float)
        rgb = np.repeat(irradiance[:, None], 3, 1) if irradiance.ndim == 1 else irradiance
        rgb = checked_array(rgb, (len(toward), 3), "irradiance_linear", finite=ValueError)
        vars(self).update(directions=toward, irradiance_linear=rgb)

    @classmethod
    def from_environment(
        cls, environment_linear: ArrayLike, count: int = 64, spread: LightSpread = "even"
    ) -> Self:
        """Return `count` lights that together shine like an environment map (H, W, 3).

        Parameters
        ----------
        environment_linear : (H, W, 3) array_like of float
            Equirectangular.
        count : int
        spread : {"even", "important"}
            "even" is `distant_directions`, the same for all maps, so that the light of two maps adds up;
            "important" is `important_directions`, which give fewer errors for the count, in that map alone.
            ValueError when it is neither.
        """
        if spread not in get_args(LightSpread):
            raise ValueError(f"spread is {spread!r}, expected one of {get_args(LightSpread)}")
        even = spread == "even"
        toward = distant_directions(count) if even else important_directions(environment_linear, count)
        return cls(toward, environment_weights(environment_linear, toward))


def distant_directions(count: int) -> FloatArray:
    """Return (K, 3) unit vectors spread evenly over the sphere, a Fibonacci spiral from +y down.

    ValueError when `count` K is below 1.

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


def important_directions(environment_linear: ArrayLike, count: int) -> FloatArray:
    """Return (K, 3) unit vectors spread as the light of an environment map is.

    A Fibonacci lattice is carried through the distribution of brightness, of which a tenth is spread evenly,
    so that dark parts keep directions too; then twice each direction moves to the brightness's centroid of
    its cell. Their `environment_weights` are alike: the edge of no light's shadow shows much. The map and its
    errors are those of `environment_weights`; ValueError when `count` K is below 1.

    .. [1] P. Debevec, "A median cut algorithm for light probe sampling", SIGGRAPH 2005 poster.

    >>> sun = np.ones((8, 16, 3))
    >>> sun[2, 4] = 1000.0
    >>> toward = important_directions(sun, 50)
    >>> int((toward @ texel_directions(sun.shape[:2])[2, 4] > 0.9).sum()) > 35
    True
    """
    image, even = checked_map(environment_linear), distant_directions(count)
    brightness = np.abs(image).mean(2)
    rows, columns = brightness.shape
    # A fine map gets means of texels, a coarse one has each of them cut up.
    if rows <= _FINEST_ROWS:
        repeat = -(-_FINEST_ROWS // rows)
        brightness = brightness.repeat(repeat, 0).repeat(repeat, 1)
    else:
        brightness = area_mean(brightness, (_FINEST_ROWS, max(columns * _FINEST_ROWS // rows, 1)))
    rows, columns = brightness.shape
    size = texel_solid_angles(rows, columns)[:, None]
    total = (brightness * size).sum()
    if not total > 0:
        return even
    share = (1 - _EVEN_SHARE) * brightness * size / total
    share += _EVEN_SHARE * size / (4 * np.pi)
    # A lattice through the inverse distribution of the shares.
    step = np.arange(count)
    down, across = (step + 0.5) / count, (step * (np.sqrt(5) - 1) / 2 + 0.5) % 1.0
    of_rows = np.concatenate([[0.0], np.cumsum(share.sum(1))])
    of_rows /= of_rows[-1]
    row = np.interp(down, of_rows, np.arange(len(of_rows), dtype=float))
    of_columns = np.concatenate([np.zeros((rows, 1)), np.cumsum(share, 1)], 1)
    of_columns /= of_columns[:, -1:]
    places = np.arange(of_columns.shape[1], dtype=float)
    own = np.minimum(row.astype(int), rows - 1)
    column = np.array([np.interp(u, of_columns[r], places) for u, r in zip(across, own, strict=True)])
    toward = map_directions(row / rows * np.pi, (column / columns - 0.5) * 2 * np.pi)
    texels, share = texel_directions((rows, columns)).reshape(-1, 3), share.ravel()
    for _ in range(2):
        nearest = cKDTree(toward).query(texels)[1]
        moments = [np.bincount(nearest, share * texels[:, k], count) for k in range(3)]
        pulled = np.stack(moments, 1).astype(float)
        toward = np.where(norms(pulled)[:, None] > 0, normalized(pulled), toward)
    return toward


def texel_directions(shape: GridShape) -> FloatArray:
    """Return (H, W, 3) unit vectors to the middles of a map's texels."""
    height, width = shape
    polar = (np.arange(height)[:, None] + 0.5) / height * np.pi
    return map_directions(polar, ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi)


def map_directions(polar_rad: ArrayLike, azimuth_rad: ArrayLike) -> FloatArray:
    """Return (..., 3) unit vectors of angles from +y down, and from +z toward +x."""
    polar, azimuth = np.broadcast_arrays(polar_rad, azimuth_rad)
    return np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], -1)


def texel_solid_angles(rows: int, columns: int) -> FloatArray:
    """Return (H,) solid angles of a map's texels in each row."""
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    return (edges[:-1] - edges[1:]) * 2 * np.pi / columns


def environment_weights(environment_linear: ArrayLike, directions: ArrayLike) -> FloatArray:
    """Return (K, 3) integrals of an environment map over each direction's cell of the sphere [1]_.

        w_k = integral of L over the directions that are nearer to k than to all others.

    The cells part the sphere, texels being constant, so the weights sum to the map's integral and are linear
    in it. Cost: one nearest-neighbour search a texel.

    `environment_linear` (H, W, 3) is radiance; rows from +y down to -y, columns by azimuth from -pi to pi,
    from +z toward +x. `directions` (K, 3) are of any length but zero. ValueError for others, or not finite.

    .. [1] J. Li et al., "MEGANE: Morphable Eyeglass and Avatar Network", CVPR 2023, supplement, section 6.3.

    >>> weights = environment_weights(np.ones((8, 16, 3)), [[0, 1, 0], [0, -1, 0]])
    >>> weights.round(4).tolist() == [[6.2832] * 3] * 2
    True
    """
    image = checked_map(environment_linear)
    tree, (height, width) = cKDTree(_checked_directions(directions)), image.shape[:2]
    repeat = max(1, -(-_FINEST_ROWS // height))
    rows, columns = height * repeat, width * repeat
    azimuth = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    # Row by row: maps may have many millions of texels.
    each_row = (map_directions((row + 0.5) / rows * np.pi, azimuth) for row in range(rows))
    nearest = np.stack([tree.query(toward)[1].astype(np.int32) for toward in each_row])
    down, across = (np.arange(side, dtype=np.int32) // repeat for side in (rows, columns))
    texel = np.add.outer(down * width, across)
    # Texels are gathered before their colour enters, so that weights stay exactly linear in the map.
    entries = np.repeat(texel_solid_angles(rows, columns), columns), (nearest.ravel(), texel.ravel())
    shares = sparse.coo_matrix(entries, shape=(tree.n, height * width)).tocsr()
    return shares @ image.reshape(-1, 3)


def checked_map(environment_linear: ArrayLike, *, several: bool = False) -> FloatArray:
    """Return a map (H, W, 3), or `several` (..., H, W, 3), as an array; ValueError where it is none."""
    shape = (..., "H", "W", 3) if several else ("H", "W", 3)
    image = checked_array(environment_linear, shape, "environment_linear", finite=ValueError)
    if image.size == 0:
        raise ValueError(f"environment_linear is {image.shape}, which holds no texel")
    return image


def _checked_directions(directions: ArrayLike) -> FloatArray:
    unit = normalized(checked_array(directions, ("K", 3), "directions", finite=ValueError))
    if not (len(unit) and unit.any(1).all()):
        raise ValueError("directions must be one or more, and not zero")
    return unit
