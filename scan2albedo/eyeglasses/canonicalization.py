"""Frames brought to the mean of their key points, without their bends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.handle_transforms import translations, turned_translations
from scan2albedo.eyeglasses.mean_keypoints import (
    align_key_points,
    mean_key_points,
    require_posable,
    unit_factors,
)
from scan2albedo.eyeglasses.options import WeightOptions
from scan2albedo.eyeglasses.skinning import skin
from scan2albedo.eyeglasses.weights import bounded_biharmonic_weights
from scan2albedo.geometry.rigid import transform_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CARRIERS = {"turned": turned_translations, "translated": translations}


@dataclass(frozen=True)
class CanonicalizationOptions:
    """Settings of `canonicalize`."""

    handles: Literal["turned", "translated"] = "turned"
    """Whether key points turn their surroundings as the skeleton turns, or only shift them (the paper's)."""
    spacing: str | float = "auto"
    """Of the weights' lattice, in the meshes' unit."""
    weights: WeightOptions = WeightOptions()


@dataclass(frozen=True)
class CanonicalEyeglasses:
    """A frame in canonical pose and shape, and the way there and back; see `canonicalize`."""

    vertices: FloatArray
    """(V, 3)."""
    faces: IntArray
    """(F, 3)."""
    weights: FloatArray
    """(V, 20); zero columns for key points that the frame lacks."""
    keypoints: FloatArray
    """(20, 3) canonical, NaN where the frame lacks them."""
    canonical_from_frame: FloatArray
    """(4, 4) rigid, after `scale`."""
    scale: float
    """Factor on the frame's coordinates before anything else; 1 unless units differ."""
    handle_transforms: FloatArray
    """(20, 4, 4) from the frame as given to canonical space, scale and rigid part included."""
    residual: float
    """Root mean square distance of the key points from the mean after the rigid part: how bent it was."""

    def apply(self, vertices: ArrayLike) -> FloatArray:
        """Return the frame's vertices (V, 3), as given or edited, in canonical space."""
        return skin(vertices, self.weights, self.handle_transforms)

    def uncanonicalize(self, vertices: ArrayLike) -> FloatArray:
        """Return canonical vertices (V, 3), edited or not, back in the frame's pose, bend and unit.

        The exact inverse of `apply`: each vertex's own blended affine map, inverted.

        Raises
        ------
        ValueError
            When there are not as many vertices as weights.
        """
        xyz = np.asarray(vertices, np.float64)
        if xyz.shape != (len(self.weights), 3):
            raise ValueError(f"vertices must have shape ({len(self.weights)}, 3), got {xyz.shape}")
        blended = (self.weights @ self.handle_transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        back = np.linalg.solve(blended[:, :, :3], (xyz - blended[:, :, 3])[:, :, None])
        return np.asarray(back[:, :, 0])


@dataclass(frozen=True)
class CanonicalSet:
    """Frames on common ground."""

    frames: tuple[CanonicalEyeglasses, ...]
    mean_keypoints: FloatArray
    """(20, 3) in the frames' unit; unless given, x to the wearer's left, z to the front, centroid at 0."""
    converged: bool
    """Whether the mean's iteration settled."""
    iterations: int
    """Of the mean; 0 when it was given."""
    units_differed: bool
    """Whether frames were scaled to one unit."""


def canonicalize(
    meshes: Sequence[Any],
    keypoints: Sequence[ArrayLike],
    *,
    weights: Sequence[ArrayLike] | None = None,
    mean_keypoints: ArrayLike | None = None,
    options: CanonicalizationOptions = CanonicalizationOptions(),
) -> CanonicalSet:
    """Bring frames to the mean of their key points: poses and bends go, shapes and thicknesses stay.

    Each frame is aligned rigidly to the mean key points x, then its key points p are moved onto them and the
    surface follows by its bounded biharmonic weights w,

        v' = sum over k of w_k (R_k (v - p_k) + x_k),

    with R_k the skeleton's turn at each key point, or R_k = 1 for v' = v + W (x - p).

    Parameters
    ----------
    meshes : sequence of n
        Pairs (vertices (V, 3), faces (F, 3)), or objects with these attributes; any unit.
    keypoints : sequence of n (20, 3) array_like
        In the mesh's unit and the order of `KEY_POINT_NAMES`; NaN for missing ones.
    weights : sequence of n (V, 20) array_like, optional
        From an earlier run; solved here otherwise, which takes nearly all the time.
    mean_keypoints : (20, 3) array_like, optional
        To bring further frames to an earlier set's mean.
    options : CanonicalizationOptions

    Raises
    ------
    EyeglassesError
        When there is no frame, key points do not fix a pose, or weights cannot be solved; names the frame.
    ValueError
        When shapes do not fit together.

    Notes
    -----
    The paper multiplies transforms and weights in a way that, read literally, collapses the frame [1]_; with
    R_k = 1 this is the sane reading. Shifts alone flatten a bend between key points, where turning ones halve
    the error; a similarity instead of a rigid transform would change the tube's thickness.

    Frames whose sizes differ more than five times are brought to one unit, see `CanonicalEyeglasses.scale`.

    References
    ----------
    .. [1] J. Li et al., "MEGANE: Morphable Eyeglass and Avatar Network", CVPR 2023, supplement, equation S2.

    Examples
    --------
    >>> from scan2albedo.synthetic import GlassesBend, eyeglasses
    >>> bent = eyeglasses(bend=GlassesBend(temple_spread_mm=8.0))
    >>> options = CanonicalizationOptions(spacing=2.5)
    >>> found = canonicalize([bent], [bent.keypoints], mean_keypoints=bent.rest_keypoints, options=options)
    >>> bool(np.abs(found.frames[0].vertices - bent.rest_vertices).max() < 0.6)
    True
    """
    points = [np.array(p, np.float64) for p in keypoints]
    surfaces = [_surface(mesh) for mesh in meshes]
    _require_sets(surfaces, points, weights)
    reference = None if mean_keypoints is None else np.asarray(mean_keypoints, np.float64)
    if reference is not None:
        require_posable(reference, -1)
    scales = unit_factors(points, reference)
    scaled = [factor * p for factor, p in zip(scales, points, strict=True)]
    found = mean_key_points(scaled) if reference is None else None
    mean = found.points if found is not None else np.asarray(reference)
    frames = []
    for p in points:
        p[~np.isfinite(mean).all(1)] = np.nan
    for i, ((vertices, faces), p) in enumerate(zip(surfaces, points, strict=True)):
        shares = _weights_of(i, vertices, faces, p, None if weights is None else weights[i], options)
        frames.append(_canonical(vertices, faces, p, shares, mean, float(scales[i]), options))
    return CanonicalSet(
        frames=tuple(frames),
        mean_keypoints=mean,
        converged=found is None or found.converged,
        iterations=0 if found is None else found.iterations,
        units_differed=bool((scales != 1).any()),
    )


def _surface(mesh: Any) -> tuple[FloatArray, IntArray]:
    vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "vertices") else mesh
    return np.asarray(vertices, np.float64), np.asarray(faces, np.int64)


def _require_sets(
    surfaces: list[tuple[FloatArray, IntArray]], points: list[FloatArray], weights: Sequence[ArrayLike] | None
) -> None:
    if not surfaces:
        raise EyeglassesError("there is no frame to canonicalise; give one mesh or more")
    for name, given in (("keypoints", points), ("weights", weights)):
        if given is not None and len(given) != len(surfaces):
            raise ValueError(
                f"{name} must have one entry for each of {len(surfaces)} meshes, got {len(given)}"
            )
    for frame, p in enumerate(points):
        require_posable(p, frame)


def _weights_of(
    frame: int,
    vertices: FloatArray,
    faces: IntArray,
    points: FloatArray,
    given: ArrayLike | None,
    options: CanonicalizationOptions,
) -> FloatArray:
    if given is not None:
        shares = np.asarray(given, np.float64)
        if shares.shape != (len(vertices), len(points)):
            raise ValueError(
                f"weights {frame} must have shape ({len(vertices)}, {len(points)}), got {shares.shape}"
            )
        return shares
    seen = np.isfinite(points).all(1)
    result = np.zeros((len(vertices), len(points)))
    try:
        result[:, seen] = bounded_biharmonic_weights(
            vertices, faces, points[seen], options.spacing, options=options.weights
        )
    except EyeglassesError as error:
        raise EyeglassesError(f"frame {frame}: {error}") from error
    return result


def _canonical(
    vertices: FloatArray,
    faces: IntArray,
    points: FloatArray,
    weights: FloatArray,
    mean: FloatArray,
    scale: float,
    options: CanonicalizationOptions,
) -> CanonicalEyeglasses:
    rigid = align_key_points(scale * points, mean)
    aligned = transform_points(rigid, scale * points)
    seen = np.isfinite((aligned + mean).sum(1))
    carriers = _CARRIERS[options.handles](aligned, mean)
    # Key points that the frame lacks weigh nothing; NaN times nothing would still be NaN.
    carriers[~seen] = np.eye(4)
    transforms = carriers @ rigid @ np.diag([scale, scale, scale, 1.0])
    return CanonicalEyeglasses(
        vertices=skin(vertices, weights, transforms),
        faces=faces,
        weights=weights,
        keypoints=np.where(seen[:, None], mean, np.nan),
        canonical_from_frame=rigid,
        scale=scale,
        handle_transforms=transforms,
        residual=float(np.sqrt(((aligned - mean)[seen] ** 2).sum(1).mean())),
    )
