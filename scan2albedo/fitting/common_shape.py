"""One neutral shape of a person from several fitted scans, and how each scan differs from it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import EPSILON, SMALLEST, FloatArray, IntArray, identities
from scan2albedo.face_model.annotation import AnnotatedSurface
from scan2albedo.face_model.variation import expression_variance, identity_modes, similarity_modes
from scan2albedo.fitting.result import NEAR_MM, UNSEEN_MM, FittedFace
from scan2albedo.geometry.fields import surface_diffusion
from scan2albedo.geometry.mesh import vertex_areas, vertex_normals
from scan2albedo.geometry.rigid import procrustes, transform_points

FIT_MM = 0.6
"""Standard deviation along an axis of a fit around the skin that it shows, mostly along the surface."""
PEOPLE_MM = 1.0
"""Standard deviation along the normal of one person's face from another's that is laid on it; seen on three
light-stage people."""


@dataclass(frozen=True)
class PersonShape:
    """A person's neutral face in the model's frame, mm, and K scans' differences from it in their order."""

    model: AnnotatedSurface
    """Of the first fit."""
    control_points: FloatArray
    vertices: FloatArray
    faces: IntArray
    """`control_points` (C, 3), `vertices` (V, 3) and `faces` (F, 3) of the limit surface."""
    landmarks: FloatArray | None
    """(68, 3)."""
    deviation_mm: FloatArray
    """(V,): standard deviation of each vertex along the normal."""
    common_from_fit: FloatArray
    """(K, 4, 4): similarities from each fitted face's frame, whose sizes have the geometric mean 1."""
    expression: FloatArray
    """(K, C, 3): displacements of the control points from the neutral face."""
    distance_mm: FloatArray
    """(K,): RMS along the normal to the others' neutral face, where it is sure; 0 for one scan."""
    other_person: FloatArray
    """(K,): log odds, even before, that the scan shows another person than the others; 0 for one scan."""


def common_shape(fits: Iterable[FittedFace]) -> PersonShape:
    """Return the neutral face that fits of one person's scans share: a maximum a posteriori estimate.

    The control points of fit k, moved by a similarity T_k, are those N of the neutral face, an expression and
    an error. At each of them, along each axis,

        T_k x_k ~ Normal(n, s_k / u_k),  u_k ~ Gamma(1/2, 1/2),  s_k = FIT_MM^2 + e + (1 - c_k) UNSEEN_MM^2,
        n ~ Normal(p, UNSEEN_MM^2),  p = the model + modes of identities with Gaussian coefficients,

    with e the variance of expressions there and c_k the part around that has scan near. The latent u_k are
    alike over NEAR_MM, so expressions are heavy-tailed and regional: expectation maximisation over n and u
    leaves out a mouth that is open in few scans. Of two scans that disagree, the likelier face counts.

    `fits` are walked through once; of each, control points and weights are kept: 70 kB with the default
    model. Raises ValueError without fits, or when their models have different triangles.
    """
    first, kept = _kept(fits)
    model = first.model
    points, shown = (np.array(of_all) for of_all in zip(*kept, strict=True))
    rest, area = model.control_vertices, vertex_areas(model.control_vertices, model.control_faces)
    around = surface_diffusion(rest, model.control_faces, NEAR_MM)
    patches, loose = area / (4 * np.pi * NEAR_MM**2), UNSEEN_MM**2
    modes, similarities = identity_modes(model), similarity_modes(rest)
    basis = np.concatenate([modes, similarities]).reshape(-1, rest.size)
    ridge = np.diag([1.0] * len(modes) + [EPSILON] * len(similarities))
    variance = FIT_MM**2 + expression_variance(model) + (1 - shown) * loose
    precision, poses = 1 / variance, identities(len(points), 4)
    neutral, likely, known = rest, rest, np.ones(len(rest))
    for step in range(50):
        seen, pulled, before = np.zeros(len(rest)), np.zeros_like(rest), neutral
        for k, own in enumerate(points):
            poses[k] = procrustes(own, neutral, weights=area * precision[k], scale=True)
            moved = transform_points(poses[k], own)
            if step:
                square = np.sum((moved - neutral) ** 2, axis=1) + 3 / known
                precision[k] = 4 / (variance[k] * (1 + around(square / variance[k])))
            seen += precision[k]
            pulled += precision[k, :, None] * moved
        known = seen + 1 / loose
        neutral = (pulled + likely / loose) / known[:, None]
        weighted = basis * np.repeat(patches / (loose + 1 / seen), 3)
        away = weighted @ (pulled / seen[:, None] - rest).ravel()
        likely = rest + (np.linalg.solve(weighted @ basis.T + ridge, away) @ basis).reshape(rest.shape)
        if np.abs(neutral - before).max() < FIT_MM / 100:
            break
    size = np.exp(np.mean(np.log(np.linalg.det(poses[:, :3, :3])))) ** (1 / 3)
    expression = np.array(
        [transform_points(pose, own) - neutral for pose, own in zip(poses, points, strict=True)]
    )
    distance, other = np.zeros((2, len(points)))
    normals = vertex_normals(neutral, model.control_faces)
    for k in range(len(points) if len(points) > 1 else 0):
        # The offset from what the other scans say, and Cauchy densities of one person's and of two's.
        others = known - precision[k]
        offset = np.sum(expression[k] * normals, axis=1) * known / others
        weight = area * shown[k] * precision[k]
        distance[k] = np.sqrt(weight @ offset**2 / weight.sum()) / size
        square, same = around(offset**2), variance[k] + 1 / others
        two = same + PEOPLE_MM**2
        other[k] = patches @ (np.log(same / two) / 2 + np.log1p(square / same) - np.log1p(square / two))
    poses[:, :3] /= size
    neutral = neutral / size
    subdivision = model.subdivision(first.levels)
    return PersonShape(
        model=model,
        control_points=neutral,
        vertices=subdivision.matrix @ neutral,
        faces=subdivision.faces,
        landmarks=model.landmarks_of(neutral),
        deviation_mm=np.sqrt(subdivision.matrix @ (1 / known)) / size,
        common_from_fit=poses,
        expression=expression / size,
        distance_mm=distance,
        other_person=other,
    )


def _kept(fits: Iterable[FittedFace]) -> tuple[FittedFace, list[tuple[FloatArray, FloatArray]]]:
    """Return the first fit, and of each its control points (C, 3) and the part (C,) around with scan near."""
    first = None
    kept = list[tuple[FloatArray, FloatArray]]()
    for fit in fits:
        first = first or fit
        if not np.array_equal(fit.model.control_faces, first.model.control_faces):
            raise ValueError(
                f"fit {len(kept)} is of {fit.model.name!r}, the first of {first.model.name!r}, whose "
                "triangles are others; fit all scans with one model"
            )
        area, spread = vertex_areas(fit.vertices, fit.faces), fit.model.subdivision(fit.levels).matrix.T
        near = spread @ (area * ~np.isnan(fit.residual_mm))
        kept.append((fit.control_points, near / np.maximum(spread @ area, SMALLEST)))
    if first is None:
        raise ValueError("no fits were given; common_shape needs one or more")
    return first, kept
