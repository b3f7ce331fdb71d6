"""Learn the prior of facial albedo (`scan2albedo.albedo.prior`) from heads whose texture is free of light.

    python tools/fit_albedo_prior.py ../shared/data/heads -o scan2albedo/albedo/data/facial_albedo.npz
    python tools/fit_albedo_prior.py ../shared/data/heads -o prior.npz --leave-out White_M_1 --likelihood

Each head is registered, fitted and sampled; its texture is averaged over cells of the chart. With mirror
images of all heads the mean is their median in each cell, the nodes of a head are those that explain its
deviation from the mean best, and `deviation` is the root mean square of what is left.

The heads are sixteen of the VALID avatars (NOTICE). `--likelihood` prints the log likelihood of each head
under the prior of the others, by SHRINKAGE and LENGTH. Mean over the heads, in nats a cell, three channels
summed (3,400 cells a head):

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

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter

import scan2albedo as s2a
from scan2albedo.albedo.prior import MEANS, NODES, AlbedoPrior
from scan2albedo.core.arrays import FloatArray

SHRINKAGE, LENGTH = 0.2, 0.1
"""The most likely ones; see above."""
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
DEVIATION_FLOOR, SPREAD_FLOOR = np.array([0.02, 0.01, 0.01]), np.array([0.03, 0.01, 0.01])
"""By channel: what sixteen heads may miss where they agree by chance."""
VARIANCE_KEPT = 0.98


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


def heads_in(folder: Path, names: Iterable[str]) -> dict[str, Head]:
    """Return the heads of a folder by name."""
    model, heads = s2a.AnnotatedFaceModel.default(), {}
    for name in names:
        scan = s2a.load_scan(folder / f"{name}.obj")
        fitted = s2a.fit(scan, model, s2a.register(scan, model, seed=0))
        heads[name] = head_of(s2a.geometry_image(fitted, scan, size=SIZE))
        print(name, heads[name].medians.round(3), flush=True)
    return heads


def centres() -> FloatArray:
    """Return (MEANS^2, 2), the places of the cells' centres."""
    return (np.indices((MEANS, MEANS)).reshape(2, -1).T + 0.5) / MEANS


def blurred(values: FloatArray, known: NDArray[np.bool_], cells: float) -> FloatArray:
    """Return values (H, W, 3), smoothed over the known cells alone."""
    weight = np.maximum(gaussian_filter(known.astype(float), cells), 1e-6)
    return gaussian_filter(np.where(known[..., None], values, 0.0), (cells, cells, 0)) / weight[..., None]


def learn(heads: Iterable[Head]) -> AlbedoPrior:
    """Return the prior of heads and their mirror images."""
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
    modes = []
    for channel in np.moveaxis(nodes, 2, 0):
        _, values, directions = np.linalg.svd(channel / np.sqrt(len(channel)), full_matrices=False)
        rank = int(np.searchsorted(np.cumsum(values**2) / np.sum(values**2), VARIANCE_KEPT)) + 1
        modes.append((values[:, None] * directions)[:rank].reshape(-1, NODES, NODES))
    most = max(map(len, modes))
    modes = [np.pad(one, ((0, most - len(one)), (0, 0), (0, 0))) for one in modes]
    medians = np.array([head.medians for head in given])
    slope, offset = np.polyfit(medians[:, 1], medians[:, 0], 1)
    # The covariance of Student's predictive distribution of one person more: it exists for five and more.
    chroma, ratios, count = AlbedoPrior.stationary().chroma, medians[:, 1:], len(given)
    if count > 4:
        one_more = (count**2 - 1) / (count * (count - 4)) * np.cov(ratios.T)
        chroma = np.vstack([ratios.mean(0), one_more])
    scatter = float(np.std(medians[:, 0] - offset - slope * medians[:, 1], ddof=2)) if len(given) > 2 else 1.0
    return AlbedoPrior(
        mean=mean,
        deviation=np.sqrt(texel + DEVIATION_FLOOR**2),
        modes=np.array(modes),
        spread=np.moveaxis(np.sqrt(gaussian_filter(power, (1, 1, 0))) + SPREAD_FLOOR, 2, 0),
        shrinkage=SHRINKAGE,
        length=LENGTH,
        level=(float(offset), float(slope), scatter),
        chroma=chroma,
        face=True,
    )


def log_likelihood(head: Head, prior: AlbedoPrior) -> float:
    """Return that of a head's cells in nats a cell, by the matrix inversion and determinant lemmas."""
    known, total = np.isfinite(head.logs).all(2), 0.0
    weights = AlbedoPrior.node_weights(centres())[known.ravel()]
    for channel in range(3):
        off = (head.logs - prior.mean)[known][:, channel]
        precision = prior.deviation[known][:, channel] ** -2
        factor = cho_factor(prior.covariance(channel), lower=True)
        inner = cho_solve(factor, np.eye(NODES**2))
        inner += (weights.T @ sparse.diags(precision) @ weights).toarray()
        posterior, pulled = cho_factor(inner, lower=True), weights.T @ (precision * off)
        squared = precision @ off**2 - pulled @ cho_solve(posterior, pulled)
        logs = sum(2 * np.log(np.diag(one)).sum() for one, _ in (factor, posterior)) - np.log(precision).sum()
        total -= (squared + logs + len(off) * np.log(2 * np.pi)) / 2
    return float(total / known.sum())


def main() -> None:
    """Sample, learn and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("heads", type=Path, help="folder of .obj files with textures")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".npz")
    parser.add_argument("--leave-out", nargs="*", default=[], metavar="NAME", help="heads not to learn from")
    parser.add_argument("--likelihood", action="store_true", help="try shrinkages and lengths")
    given = parser.parse_args()
    names = sorted({path.stem for path in given.heads.glob("*.obj")} - set(given.leave_out))
    heads = heads_in(given.heads, names)
    if given.likelihood:
        lengths = 0.05, 0.07, 0.1, 0.15, 0.2
        print("shrinkage", *lengths, sep="\t")
        priors = {name: learn(heads[other] for other in names if other != name) for name in names}
        for share in (0.0, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9):
            tried = [
                [log_likelihood(heads[n], replace(priors[n], shrinkage=share, length=one)) for n in names]
                for one in lengths
            ]
            print(share, *np.mean(tried, axis=1).round(3), sep="\t")
    prior = learn(heads.values())
    prior.save(given.output)
    print(f"{given.output}: {given.output.stat().st_size / 1000:.0f} kB, level {np.round(prior.level, 3)}")


if __name__ == "__main__":
    main()
