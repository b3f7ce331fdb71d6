"""Exemplar synthesis of texels whose colour a highlight has wiped out."""

import numpy as np

from scan2albedo.albedo.node_field import FAINT
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, finite_rows
from scan2albedo.core.compiled import compiled
from scan2albedo.geometry.fields import filled_over_grid, surroundings

_HOLD = 1e-4
"""Weight by which a copy keeps its own level: felt from 100 texels on, where gradients add up to drift."""
RADIUS = 40 / 512


def resynthesize(
    albedo: FloatArray,
    target: BoolArray,
    source: BoolArray,
    *,
    context: BoolArray | None = None,
    seed: int = 0,
) -> FloatArray:
    """Fill `target` with texture copied texel by texel from `source` around it, its seams blended.

    Non-hierarchical resynthesis [1]_: texels with most known neighbours come first; each takes the value of
    the place, among where its neighbours came from and random places within the search radius (40 texels at
    512), whose surroundings resemble its own most. Surroundings are compared in log albedo over the nearest
    known texels by sum min(1, x), with x the squared difference over the texture's own variance. The
    gradients that the copies had at their origin are then integrated inwards from the border [2]_: no step is
    left where copies meet. No channel gets darker or brighter than all that is known.

    `albedo` (H, W, 3) is returned unchanged outside `target`, and everywhere when there is no source. Texels
    of `context` are compared with but not copied, beside the sources. ValueError when texels of `source` or
    `context` are not finite. The cost grows with the number of texels to fill. [1]_ compares 30 neighbours at
    80 places; less is as good on skin, but on large holes in wood the joints can then be seen.

    .. [1] P. Harrison, "A non-hierarchical procedure for re-synthesis of complex textures", WSCG 2001.
    .. [2] P. Perez, M. Gangnet, A. Blake, "Poisson image editing", SIGGRAPH 2003.
    """
    origin = source & ~target
    if not target.any() or not origin.any():
        return albedo
    known = origin if context is None else origin | (context & ~target)
    if bad := int((~finite_rows(albedo[known])).sum()):
        raise ValueError(f"{bad} of {known.sum()} texels to copy from or compare with are not finite")
    radius = max(4, round(RADIUS * max(target.shape)))
    window = surroundings(target, radius)
    if not origin[window].any():
        window = (slice(None), slice(None))
    reach = max(6, radius // 4)
    # With a rim of nothing known around it no index has to be checked.
    inside, copies, around = (np.pad(part[window], reach) for part in (target, origin, known))
    field = np.zeros((*inside.shape, 3), np.float32)
    field[reach:-reach, reach:-reach] = np.log(np.maximum(albedo[window].astype(np.float32), FAINT))
    order = _order(inside, around)
    # Offsets of neighbours without (0, 0), the nearest first.
    offsets = np.stack([grid.ravel() for grid in np.indices((2 * reach + 1, 2 * reach + 1)) - reach], 1)
    offsets = offsets[np.argsort((offsets**2).sum(1), kind="stable")[1:]]
    rng = np.random.default_rng(seed)
    # Random places that are tried for a texel; as many of its neighbours are compared.
    jumps = rng.integers(-radius, radius + 1, (len(order), 14, 2), np.int32)
    steep = np.float32(1 / max(field[copies].var(0).mean(), 1e-6))
    places = np.argwhere(copies)
    filled, came_from = _fill(field, order, copies, around, offsets, places, jumps, steep, rng)
    across, down = (copied_steps(filled, field, came_from, around, axis) for axis in (1, 0))
    filled = filled_over_grid(filled, inside, around, across=across, down=down, pull=_HOLD)
    result = albedo.copy()
    new = np.exp(filled[inside], dtype=float)
    result[window][target[window]] = np.clip(new, albedo[known].min(0), albedo[known].max(0))
    return result


def _order(target: BoolArray, known: BoolArray) -> IntArray:
    """Return (T, 2) the target's texels, those with most known neighbours first, in layers.

    Each layer takes the texels with at least three known neighbours (or as many as there are).
    """
    done, left, layers = known.copy(), np.argwhere(target), []
    while len(left):
        near = left[:, None] + np.indices((3, 3)).reshape(2, -1).T - 1
        count = done[near[..., 0], near[..., 1]].sum(1)
        enough = count >= min(3, count.max())
        layer = left[np.argsort(-count, kind="stable")[: enough.sum()]]
        layers.append(layer)
        done[tuple(layer.T)] = True
        left = left[~enough]
    return np.concatenate(layers)


@compiled
def _fill(field, order, origin, context, offsets, places, jumps, precision, rng):  # type: ignore[no-untyped-def]
    """Return `field` with the texels of `order` filled one after another, and where they came from.

    That is (H, W, 2) rows and columns, -1 where nothing was copied. `jumps` (T, P, 2) lead to the random
    places that are tried, P neighbours being compared; when none serves, farther ones are drawn from `rng`,
    and from the sources' own `places` (S, 2) when even those that reach across the image miss.
    """
    height, width = origin.shape
    result, known = field.copy(), context.copy()
    came_from = np.full((height, width, 2), -1)
    near, own = np.empty((jumps.shape[1], 2), np.int64), np.empty((jumps.shape[1], 3), np.float32)
    for t in range(order.shape[0]):
        row, column = order[t, 0], order[t, 1]
        # The nearest known texels, and their values.
        found = 0
        for k in range(len(offsets)):
            i, j = row + offsets[k, 0], column + offsets[k, 1]
            if known[i, j]:
                near[found], own[found] = offsets[k], result[i, j]
                found += 1
                if found == len(near):
                    break
        best, best_row, best_column = np.float32(np.inf), -1, -1
        attempt = 0
        probes = jumps.shape[1]
        reach = 2
        while attempt < found + probes or best_row < 0:
            if attempt < found:
                m, n = row + near[attempt, 0], column + near[attempt, 1]
                # Beside a neighbour that was not copied lies the texel itself: nothing to copy there.
                copied = came_from[m, n, 0] >= 0
                i, j = came_from[m, n, 0] - near[attempt, 0], came_from[m, n, 1] - near[attempt, 1]
                attempt += 1
                if not copied:
                    continue
            elif attempt < found + probes:
                i, j = row + jumps[t, attempt - found, 0], column + jumps[t, attempt - found, 1]
                attempt += 1
            elif reach == height + width:
                i, j = places[rng.integers(0, len(places))]
            else:
                reach = min(2 * reach, height + width)
                i = row + int(rng.integers(-reach, reach + 1))
                j = column + int(rng.integers(-reach, reach + 1))
            if not (0 <= i < height and 0 <= j < width and origin[i, j]):
                continue
            # How much the surroundings differ; the sum ends when it reaches the best one.
            distance = np.float32(0)
            for k in range(found):
                a, b, apart = i + near[k, 0], j + near[k, 1], np.float32(1)
                if context[a, b]:
                    red, green = own[k, 0] - field[a, b, 0], own[k, 1] - field[a, b, 1]
                    blue = own[k, 2] - field[a, b, 2]
                    apart = min(apart, precision * (red * red + green * green + blue * blue))
                distance += apart
                if distance >= best:
                    break
            if distance < best:
                best, best_row, best_column = distance, i, j
        result[row, column] = field[best_row, best_column]
        came_from[row, column] = best_row, best_column
        known[row, column] = True
    return result, came_from


def copied_steps(
    filled: FloatArray, field: FloatArray, came_from: IntArray, known: BoolArray, axis: int
) -> FloatArray:
    """Return the forward differences along an axis that copies should have: those where they came from.

    Across the border that is the step beside the place the copy came from; the left or upper texel of a pair
    is asked first. Where two copies meet it is the mean of that and of their own difference: the first alone
    takes a quarter of the texture's variance away, the second adds some.
    """
    front, back = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
    there, pairs = np.diff(field, axis=axis), known[front] & known[back]
    own = np.diff(filled, axis=axis)
    steps, both = np.zeros_like(own), np.ones(own.shape[:2], bool)
    for end, before in ((back, 1), (front, 0)):
        place = came_from[end].copy()
        good = place[..., 0] >= 0
        both &= good
        place[..., axis] -= before
        good &= pairs[place[..., 0], place[..., 1]]
        steps[good] = there[place[good][:, 0], place[good][:, 1]]
    steps[both] = (steps + own)[both] / 2
    return steps
