"""Learn the prior of facial albedo (`scan2albedo.albedo.prior`) from heads whose texture is free of light.

Each head is registered, fitted and sampled; its texture is averaged over cells of the chart. With mirror
images of all heads the mean is their median in each cell, the nodes of a head are those that explain its
deviation from the mean best, and `deviation` is the root mean square of what is left.

The heads are sixteen of the VALID avatars (NOTICE). This is the log likelihood of each head under the prior
of the others, by SHRINKAGE and LENGTH: mean over the heads, in nats a cell, three channels summed (3,400
cells a head; `--likelihood` of tools/fit_albedo_prior.py of commit 1592766c printed it):

    shrinkage   length .05    .07    .10    .15    .20
    0                 4.06   4.08   4.08   4.06   4.04
    0.2               4.10   4.12   4.12   4.12   4.10
    0.3               4.11   4.12   4.12   4.11   4.10
    0.5               4.11   4.12   4.11   4.08   4.05
    0.7               4.08   4.08   4.05   4.00   3.94
    0.9               3.82   3.80   3.73   3.60   3.48

Some heads share much of their texture: deviations of Asian_M_1 and Asian_M_3 correlate by 0.93, those of
Black_F_2 and Black_M_2 by 0.90. With all heads of a group left out at once, shrinkages of 0, 0.2, 0.3 and 0.5
give 3.81, 3.82, 3.81 and 3.76 at a length of 0.10: of the two that are best above the lesser is taken. The
level that a head's chroma speaks for is off by 0.23 (root mean square) with that head left out, and by 0.52
with its group.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import scan2albedo as s2a
from build import fitted_heads, output
from scan2albedo.albedo.prior import MEANS, NODES, AlbedoPrior
from scan2albedo.core.arrays import FloatArray

SHRINKAGE = 0.2
"""The most likely one; see above."""
LENGTH = 0.1
"""The most likely one, in sides of the chart; see above."""
SIZE = 256
"""Texels a side of the geometry images: 4 x 4 in each cell."""
DARKEST = 0.004
"""Least linear colour of a cell: there pictures of 8 bits lie in steps of a tenth, and hold noise alone."""
LEAST_SKIN = 0.2
"""Of a cell that counts as skin."""
RIDGE = 0.05
"""Precision that ties nodes to 0, relative to that of one cell: nodes beyond the chart stay there."""
OUTLIER = 0.5
"""Residuals of log colour beyond are cut off: jewellery and edges of hair are no texture of skin."""
DEVIATION_FLOOR = np.array([0.02, 0.01, 0.01])
"""Of a cell, by channel: what sixteen heads may miss where they agree by chance."""
SPREAD_FLOOR = np.array([0.03, 0.01, 0.01])
"""The same of a node."""
VARIANCE_KEPT = 0.98
"""Part of the variance of nodes that the modes hold."""


@dataclass(frozen=True)
class Head:
    """`logs` (MEANS, MEANS, 3) less `medians` (3,) over skin, NaN where unseen; channels as the prior's."""

    logs: FloatArray
    medians: FloatArray


def head_of(image: s2a.GeometryImage) -> Head:
    """Return the colours of a sampled head by cells of the chart."""
    assert image.texture_linear is not None
    assert image.skin is not None
    shape = (MEANS, SIZE // MEANS, MEANS, SIZE // MEANS, -1)
    layers = np.dstack([image.texture_linear, image.skin, np.ones(image.shape)])
    *sums, count = np.where(image.seen[..., None], layers, 0).reshape(shape).sum((1, 3)).transpose(2, 0, 1)
    red, green, blue, skin = sums / np.maximum(count, 1)
    red, green, blue = np.maximum([red, green, blue], DARKEST)
    known = count >= (SIZE // MEANS) ** 2 / 2
    logs = np.log(np.dstack([np.maximum(np.maximum(red, green), blue), green / red, blue / red]))
    medians = np.median(logs[known & (skin > LEAST_SKIN)], axis=0)
    return Head(np.where(known[..., None], logs - medians, np.nan), medians)


def centres() -> FloatArray:
    """Return (MEANS^2, 2), the places of the cells' centres."""
    return (np.indices((MEANS, MEANS)).reshape(2, -1).T + 0.5) / MEANS


def blurred(values: FloatArray, known: NDArray[np.bool_], cells: float) -> FloatArray:
    """Return values (H, W, 3), smoothed over the known cells alone."""
    weight = np.maximum(gaussian_filter(known.astype(float), cells), 1e-6)
    return gaussian_filter(np.where(known[..., None], values, 0.0), (cells, cells, 0)) / weight[..., None]


def learn(heads: Iterable[Head]) -> AlbedoPrior:
    """Return the prior of five heads or more, and their mirror images."""
    given = list(heads)
    logs = np.array([side for head in given for side in (head.logs, head.logs[:, ::-1])])
    known = np.isfinite(logs).all(3).any(0)
    mean = np.zeros(logs.shape[1:])
    mean[known] = np.nanmedian(logs[:, known], axis=0)
    mean = np.where(known[..., None], mean, blurred(mean, known, 3.0))
    off = np.nan_to_num(logs - mean)
    # Nodes x of each head minimise |B x - off|^2 + RIDGE |x|^2 over the known cells.
    weights = AlbedoPrior.node_weights(centres())
    inside = weights[known.ravel()]
    normal = (inside.T @ inside).toarray() + RIDGE * np.eye(NODES**2)
    flat = off.reshape(len(off), MEANS**2, 3)
    nodes = np.stack([np.linalg.solve(normal, inside.T @ one[known.ravel()]) for one in flat])
    left = (flat - np.stack([weights @ one for one in nodes])).reshape(off.shape)
    texel = blurred((np.clip(left, -OUTLIER, OUTLIER) ** 2).mean(0), known, 1.5)
    power = (nodes**2).mean(0).reshape(NODES, NODES, 3)
    medians = np.array([head.medians for head in given])
    slope, offset = np.polyfit(medians[:, 1], medians[:, 0], 1)
    scatter = float(np.std(medians[:, 0] - offset - slope * medians[:, 1], ddof=2))
    # The covariance of Student's predictive distribution of one person more: it exists for five and more.
    ratios, count = medians[:, 1:], len(given)
    one_more = (count**2 - 1) / (count * (count - 4)) * np.cov(ratios.T)
    return AlbedoPrior(
        mean=mean,
        deviation=np.sqrt(texel + DEVIATION_FLOOR**2),
        modes=modes_of(nodes),
        spread=np.moveaxis(np.sqrt(gaussian_filter(power, (1, 1, 0))) + SPREAD_FLOOR, 2, 0),
        shrinkage=SHRINKAGE,
        length=LENGTH,
        level=(float(offset), float(slope), scatter),
        chroma=np.vstack([ratios.mean(0), one_more]),
        face=True,
    )


def modes_of(nodes: FloatArray) -> FloatArray:
    """Return (3, R, NODES, NODES): principal directions of nodes (N, NODES^2, 3), times their deviation."""
    modes = []
    for channel in np.moveaxis(nodes, 2, 0):
        _, values, directions = np.linalg.svd(channel / np.sqrt(len(channel)), full_matrices=False)
        rank = int(np.searchsorted(np.cumsum(values**2) / np.sum(values**2), VARIANCE_KEPT)) + 1
        modes.append((values[:, None] * directions)[:rank].reshape(-1, NODES, NODES))
    most = max(map(len, modes))
    return np.array([np.pad(one, ((0, most - len(one)), (0, 0), (0, 0))) for one in modes])


def main(arguments: list[str]) -> None:
    """Sample, learn and write."""
    file = output(arguments, "albedo/data/facial_albedo.npz")
    prior = learn(head_of(s2a.geometry_image(fitted, scan, size=SIZE)) for _, scan, fitted in fitted_heads())
    prior.save(file)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB, level {np.round(prior.level, 3)}")
