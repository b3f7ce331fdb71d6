"""The image at several sizes: texels averaged into cells, with weights and partitions into blocks."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt, map_coordinates, uniform_filter

from scan2albedo.albedo.noise import WINDOW
from scan2albedo.albedo.options import MINIMAL_TEXELS, SATURATION_LINEAR
from scan2albedo.core import GeometryImage
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, NDArray, RealArray, norms
from scan2albedo.core.compiled import compiled
from scan2albedo.errors import LightingError
from scan2albedo.geometry.mesh import lengths, normalized
from scan2albedo.lighting.environment_light import SMALLEST_MM, surface_keys

_BLOCK_AREA = 0.125
"""Area of a block of constant albedo as a part of the chart's: larger than the texture's grain."""
_NOT_SKIN = 0.25
"""Weight of what is not skin: without any, nothing is known of the light below a beard."""


@dataclass(frozen=True)
class Level:
    """N cells of the image at one size.

    `position`, `normal` and `toward`, the direction to the camera, (N, 3) are means, directions of unit
    length again. `anchor` (N, 3) is a texel's position, where shadow rays start: it lies on the surface, as
    the mean need not. `value` (N,) and `color` (N, 3) are the mean V and colour of the linear texture divided
    by `unit`, the median V of the usable texels, also the unit of the highlight's strength. `weight` (N,) is
    the usable part of a cell's texels times their mean skin, `scale` (N,) the annotated strength of
    highlights. `cell` (N, 2) is row and column among the cells, `center` (N, 2) their mean among the texels.
    `texels` counts those of the whole face; `factor` is the side of a cell in texels.
    """

    position: FloatArray
    normal: FloatArray
    toward: FloatArray
    anchor: FloatArray
    value: FloatArray
    weight: FloatArray
    scale: FloatArray
    unit: float
    color: FloatArray
    cell: IntArray
    center: FloatArray
    texels: int
    factor: int

    def blocks(self) -> tuple[NDArray[np.int32], int]:
        """Return (2, N) the block of each cell in two partitions, and how many blocks there are.

        Blocks are squares; those of the second partition are moved by half a side along both axes.
        """
        side, low = math.sqrt(_BLOCK_AREA * self.texels), self.center.min(0)
        found = []
        total = 0
        for shift in (0.0, 0.5):
            row, column = (np.floor((self.center - low) / side + shift).astype(int)).T
            _, index = np.unique(row * 100_000 + column, return_inverse=True)
            found.append(index + total)
            total += int(index.max()) + 1
        return np.stack(found).astype(np.int32), total


def brightest_around(texture_linear: Float32Array, usable: BoolArray) -> FloatArray:
    """Return (H, W) the channel that is the brightest on average around each texel: V, but for its noise."""
    chosen = uniform_filter(usable[..., None] * texture_linear, (WINDOW, WINDOW, 1)).argmax(-1)
    return np.take_along_axis(texture_linear, chosen[..., None], -1)[..., 0].astype(float)


def usable_texels(image: GeometryImage) -> BoolArray:
    """Return (H, W) texels that the search may trust: seen, neither black nor clipped, with a normal.

    LightingError without a texture, or with fewer than `MINIMAL_TEXELS` such texels; GeometryImageError for
    normals of another length than 1, or 0 where none is known.
    """
    if image.texture_linear is None:
        raise LightingError("the geometry image has no texture: no light can be found; give a textured scan")
    if not image.mask.any():
        raise LightingError("the mask of the geometry image is empty: there is no surface to light")
    image.check_normals()
    seen, (red, green, blue) = image.seen, np.moveaxis(image.texture_linear, -1, 0)
    value = np.maximum(np.maximum(red, green), blue)
    black, clipped = value <= 0, value >= SATURATION_LINEAR
    with_normal = seen & (lengths(image.normal) > 0.5)
    usable = with_normal & ~black & ~clipped
    if usable.sum() < MINIMAL_TEXELS:
        raise LightingError(
            f"only {usable.sum()} of {image.mask.sum()} texels can be used to find the light "
            f"(seen {seen.sum()}, of these black {(seen & black).sum()}, "
            f"saturated {(seen & clipped).sum()}, with a normal {with_normal.sum()}); at least "
            f"{MINIMAL_TEXELS} are needed: check the texture's exposure and `texture_valid`, "
            "and scale textures that go beyond 1"
        )
    return usable


def build_level(
    image: GeometryImage,
    usable: BoolArray,
    size: int,
    values: RealArray | None = None,
    toward: FloatArray | None = None,
) -> Level:
    """Average the face's usable texels of V, or of `values` (H, W), into cells, `size` along its side.

    `toward` (P, 3) are the masked texels' directions to the camera, to the front when None.
    """
    assert image.texture_linear is not None
    field = brightest_around(image.texture_linear, usable) if values is None else values
    if image.on_face is not None and (usable & image.on_face).any():
        usable = usable & image.on_face
    factor = max(1, math.ceil(image.face_side / size))
    across = -(-image.shape[1] // factor)
    row, column = np.nonzero(usable)
    number = row // factor * across + column // factor
    count = np.bincount(number)
    found = np.flatnonzero(count)
    index, count = (np.cumsum(count > 0) - 1)[number], count[found]
    each = np.arange(len(index) + 1)
    cells = sparse.csc_matrix((np.ones(len(index)), index, each), (len(found), len(index)))

    def mean(field: NDArray, texels: BoolArray = usable) -> FloatArray:
        return np.asarray(cells @ field[texels].reshape(len(index), -1)) / count[:, None]

    position, value = mean(image.position), mean(field)[:, 0]
    scale = np.ones(len(value)) if image.specular_scale is None else mean(image.specular_scale)[:, 0]
    toward = image.toward_camera((0.0, 0.0, 1.0)) if toward is None else toward
    texels = image.position[usable].astype(float)
    apart = norms(texels - position[index])
    closest = np.lexsort((apart, index))
    anchor = texels[closest[np.searchsorted(index[closest], np.arange(len(found)))]]
    unit = max(float(np.median(field[usable])), 1e-12)
    # Hair, eyes and cloth take part by a quarter; of a surface without skin every texel takes part alike.
    part = np.ones(image.shape)
    if image.skin is not None and (image.skin[usable] > _NOT_SKIN).any():
        part = np.maximum(image.skin, _NOT_SKIN)
    normal, ahead = normalized(mean(image.normal)), normalized(mean(toward, usable[image.mask]))
    weight, color = count / factor**2 * mean(part)[:, 0], mean(image.texture_linear) / unit
    cell = np.stack(np.divmod(found, across), 1)
    center = mean(np.stack([row, column], 1), np.ones(len(row), bool))
    whole = int((image.mask if image.on_face is None else image.on_face).sum())
    seen = position, normal, ahead, anchor, value / unit, weight, scale, unit, color
    return Level(*seen, cell, center, whole, factor)


def cell_means(level: Level, values: FloatArray, mask: BoolArray) -> FloatArray:
    """Return (N,) the mean over each cell's texels within `mask` (H, W) of `values` there."""
    across = -(-mask.shape[1] // level.factor)
    row, column = np.nonzero(mask)
    number, cell = row // level.factor * across + column // level.factor, level.cell @ (across, 1)
    sums, count = np.bincount(number, values), np.bincount(number)
    return sums[cell] / count[cell]


def cell_field(level: Level, values: FloatArray, mask: BoolArray) -> FloatArray:
    """Return (P, C) `values` (N, C) of the cells on the P texels of `mask`, linear along the chart."""
    grid, at = values[_nearest_cells(level, mask)], (np.argwhere(mask).T + 0.5) / level.factor - 0.5
    fields = [map_coordinates(part, at, order=1, mode="nearest") for part in np.moveaxis(grid, -1, 0)]
    return np.stack(fields, 1)


def _nearest_cells(level: Level, mask: BoolArray) -> IntArray:
    """Return (h, w) the number of each cell of the chart, or of the nearest one that there is."""
    row, column = level.cell.T
    number = np.full(tuple(-(-side // level.factor) for side in mask.shape), -1)
    number[row, column] = np.arange(len(row))
    nearest = distance_transform_edt(number < 0, return_distances=False, return_indices=True)
    return number[tuple(nearest)]


def along_surface(level: Level, values: FloatArray, image: GeometryImage) -> FloatArray:
    """Return (P, C) `values` (N, C) of the cells on the P masked texels, from four cells near each.

    Of the cells beside it in the chart, they are the closest by `surface_keys`: no value leaks over a fold,
    or a cut of the chart.
    """
    mask, found = image.mask, np.empty((int(image.mask.sum()), values.shape[1]))
    texels = surface_keys(image.position[mask], image.normal[mask])
    cells, number = surface_keys(level.anchor, level.normal), _nearest_cells(level, mask)
    _from_four_cells(np.argwhere(mask), texels, level.factor, number, cells, values, SMALLEST_MM, found)
    return found


@compiled
def _from_four_cells(at, texels, factor, number, cells, values, smallest, found):  # type: ignore[no-untyped-def]
    """Fill `found` (P, C) at the texels `at` (P, 2); `texels` (P, 6) and `cells` (N, 6) are keys."""
    squares, chosen = np.empty(4), np.empty(4, np.int64)
    for p in range(len(at)):
        row, column = at[p, 0] // factor, at[p, 1] // factor
        squares[:] = np.inf
        chosen[:] = 0
        for i in range(max(row - 1, 0), min(row + 2, number.shape[0])):
            for j in range(max(column - 1, 0), min(column + 2, number.shape[1])):
                square = 0.0
                for k in range(6):
                    square += (texels[p, k] - cells[number[i, j], k]) ** 2
                if square >= squares[3]:
                    continue
                place = 3
                while place > 0 and square < squares[place - 1]:
                    squares[place], chosen[place] = squares[place - 1], chosen[place - 1]
                    place -= 1
                squares[place], chosen[place] = square, number[i, j]
        found[p] = 0.0
        total = 0.0
        for place in range(4):
            weight = 1 / (np.sqrt(squares[place]) + smallest) ** 2
            total += weight
            for c in range(values.shape[1]):
                found[p, c] += weight * values[chosen[place], c]
        for c in range(values.shape[1]):
            found[p, c] /= total
