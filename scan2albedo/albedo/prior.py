"""What is known of an albedo before its light: a Gaussian over the chart, of faces or stationary."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy import sparse
from scipy.spatial.distance import cdist

from scan2albedo.core.arrays import ArrayLike, FloatArray, all_finite
from scan2albedo.errors import LightingError
from scan2albedo.geometry.rasterization import bilinear
from scan2albedo.io.npz import read_npz, write_npz

NODES = 16
"""Cells a side of the grid of a person's deviations over the chart's unit square. Values stand at the cells'
centres, row 0 at v = 1. Finer nodes explain heads left out better (32: by 0.6 nats a cell), but their
factorisations cost NODES^6."""
MEANS = 64
"""The same of the grid of means."""

SPREADS = (0.25, 0.1, 0.1)
"""Of a surface that may be anything: standard deviations of log colour over it, by channel."""
_LENGTH = 0.1
"""Correlation length of these, in sides of the chart."""
_DEVIATIONS = (0.03, 0.02, 0.02)
"""Standard deviations of its single texels, by channel."""
_LEVEL = (0.4, 0.3)
"""Its mean albedo, and the relative deviation of that."""

_SHAPES: dict[str, tuple[int | None, ...]] = {
    "mean": (MEANS, MEANS, 3),
    "deviation": (MEANS, MEANS, 3),
    "modes": (3, None, NODES, NODES),
    "spread": (3, NODES, NODES),
    "shrinkage": (),
    "length": (),
    "level": (3,),
    "chroma": (3, 2),
    "face": (),
}
"""Of the arrays of a file."""


@dataclass(frozen=True)
class AlbedoPrior:
    """A Gaussian prior of log albedo over the chart, channel by channel.

    The channels are log(red), log(green / red) and log(blue / red), each less its median over the person's
    skin; red leads on skin. At a place with bilinear weights w (`node_weights`) a channel is

        m + w x + e,   x ~ N(0, C),   e ~ N(0, s^2) independent at each texel,
        C_ij = lambda sum_r q_ri q_rj + (1 - lambda) t_i t_j exp(-d_ij / l)

    with `mean` m, `deviation` s, `modes` q of a sample covariance, shrunk [1]_ by `shrinkage` lambda toward
    an exponential covariance of `spread` t and `length` l; d_ij is the distance of two nodes.

    .. [1] O. Ledoit, M. Wolf, "A well-conditioned estimator for large-dimensional covariance matrices",
       Journal of Multivariate Analysis 88(2), 2004: shrinkage of a sample covariance.
    """

    mean: FloatArray
    """(MEANS, MEANS, 3)."""
    deviation: FloatArray
    """(MEANS, MEANS, 3): standard deviation of a texel that the nodes do not carry."""
    modes: FloatArray
    """(3, R, NODES, NODES): deviations whose outer products sum to the sample covariance of a channel."""
    spread: FloatArray
    """(3, NODES, NODES): standard deviation of the stationary part."""
    shrinkage: float
    """Share of the sample covariance, 0 to 1."""
    length: float
    """Over which the stationary part loses its correlation (to 1/e), in sides of the chart."""
    level: tuple[float, float, float]
    """(a, b, c): a person's median log(red) is a + b times the median log(green / red), with standard
    deviation c."""
    chroma: FloatArray
    """(3, 2): mean of a person's median log(green / red) and log(blue / red), and their covariance."""
    face: bool
    """Whether it was learned from faces: places are then those of `GeometryImage.face_chart`."""

    @staticmethod
    @lru_cache(maxsize=1)
    def faces() -> AlbedoPrior:
        """Return the prior of faces that ships with the package (cached; `tools/build/albedo_prior.py`)."""
        with as_file(files("scan2albedo.albedo") / "data" / "facial_albedo.npz") as path:
            return AlbedoPrior.load(path)

    @classmethod
    def by_name(cls, name: str, *, face: bool) -> AlbedoPrior:
        """Return what `EstimateOptions.prior` names; `face`: whether the image lies on the chart of faces."""
        if name == "auto" and face:
            return cls.faces()
        return cls.stationary() if name in ("auto", "stationary") else cls.load(name)

    @classmethod
    def stationary(cls) -> Self:
        """Return a prior of surfaces of which nothing is known: alike at all places, of any colour."""
        return cls(
            mean=np.zeros((MEANS, MEANS, 3)),
            deviation=np.tile(_DEVIATIONS, (MEANS, MEANS, 1)),
            modes=np.zeros((3, 0, NODES, NODES)),
            spread=np.array(SPREADS)[:, None, None] * np.ones((NODES, NODES)),
            shrinkage=0.0,
            length=_LENGTH,
            level=(float(np.log(_LEVEL[0])), 0.0, _LEVEL[1]),
            chroma=np.vstack([np.zeros(2), 100 * np.eye(2)]),
            face=False,
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a prior that `save` wrote; `LightingError` for anything else."""
        what, advice = "albedo prior", "give a file that `AlbedoPrior.save` wrote"
        found: dict[str, Any] = read_npz(path, tuple(_SHAPES), what=what, advice=advice, error=LightingError)
        for name, shape in _SHAPES.items():
            got = found[name].shape
            same_shape = len(got) == len(shape) and all(
                b in (a, None) for a, b in zip(got, shape, strict=True)
            )
            if not same_shape or found[name].dtype.kind not in "bf" or not all_finite(found[name]):
                expected = str(shape).replace("None", "R")
                raise LightingError(
                    f"{what} {path}: {name} is {found[name].dtype} of shape {got}, expected finite numbers "
                    f"of shape {expected}; {advice}"
                )
            found[name] = found[name].astype(float)
        a, b, c = found.pop("level").tolist()
        least = np.linalg.eigvalsh(found["chroma"][1:])[0]
        if not (min(found["deviation"].min(), found["spread"].min(), found["length"], c, least) > 0):
            names = "deviation, spread, length, level or chroma"
            raise LightingError(f"{what} {path}: {names} is not above 0; {advice}")
        numbers = {name: float(found.pop(name)) for name in ("shrinkage", "length")}
        return cls(**found | numbers | {"level": (a, b, c), "face": bool(found["face"])})

    def save(self, path: str | Path) -> None:
        """Write the prior as an .npz file in half precision, whole or not at all; same prior, same bytes."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _SHAPES}
        half = {n: a.astype(np.float16) if a.ndim > 1 else a for n, a in arrays.items()}
        write_npz(path, half, what="albedo prior", compression=9)

    def covariance(self, channel: int) -> FloatArray:
        """Return (NODES^2, NODES^2), the covariance C of a channel's nodes in row-major order."""
        modes, spread = (field[channel].reshape(-1, NODES**2) for field in (self.modes, self.spread))
        centres = (np.indices((NODES, NODES)).reshape(2, -1).T + 0.5) / NODES
        stationary = spread.T @ spread * np.exp(-cdist(centres, centres) / self.length)
        return self.shrinkage * modes.T @ modes + (1 - self.shrinkage) * stationary

    def mean_at(self, places: ArrayLike) -> FloatArray:
        """Return (N, 3), the mean at places (N, 2): row and column on the chart, both from 0 to 1."""
        return bilinear(self.mean, np.asarray(places, float)[:, ::-1] * MEANS - 0.5)

    def deviation_at(self, places: ArrayLike, channels: slice = slice(None)) -> FloatArray:
        """Return (N, 3), the standard deviation that no node carries; see `mean_at`."""
        return bilinear(self.deviation[..., channels], np.asarray(places, float)[:, ::-1] * MEANS - 0.5)

    @staticmethod
    def node_weights(places: ArrayLike) -> sparse.csr_matrix:
        """Return (N, NODES^2) bilinear weights of the nodes at places (N, 2); rows sum to 1."""
        at = np.clip(np.asarray(places, float) * NODES - 0.5, 0, NODES - 1)
        first = np.minimum(at.astype(int), NODES - 2)
        corner = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        share = (1 - corner + (2 * corner - 1) * (at - first)[:, None]).prod(2)
        index = (first[:, None] + corner) @ [NODES, 1]
        return sparse.csr_matrix(
            (share.ravel(), index.ravel(), np.arange(0, share.size + 1, 4)), (len(at), NODES**2)
        )
