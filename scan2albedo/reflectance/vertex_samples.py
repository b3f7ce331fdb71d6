"""`CaptureRig`, from where pictures were taken and lit, and `VertexSamples`, what they show of V vertices."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import (
    SMALLEST,
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    all_finite,
    checked_array,
    norms,
)
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.geometry.mesh import face_cross_products, normalized
from scan2albedo.geometry.pinhole import camera_centers, normalized_cameras, project
from scan2albedo.geometry.rigid import compose, is_rigid
from scan2albedo.reflectance.olat import OlatImages
from scan2albedo.reflectance.point_light_lobes import lobes_and_slopes, turn_lobes
from scan2albedo.reflectance.vertex_visibility import VertexVisibility, checked_surface, pixels_around


@dataclass(frozen=True)
class CaptureRig:
    """Cameras and flashes of J pictures, in the face's frame; `ReflectanceError` for other shapes or NaN."""

    cameras: FloatArray
    """(J, 3, 4): projection matrices, pixels (column, row) from points in mm, normalised so that depth is
    third."""
    light_positions: FloatArray
    """(J, 3): of the flash that lit each picture, in mm."""
    light: IntArray
    """(J,): number of that flash, 0, 1, ..."""

    def __post_init__(self) -> None:
        with errors_of("the cameras of the rig cannot be used", ReflectanceError, ValueError):
            cameras = normalized_cameras(self.cameras)
        count, wrong = len(cameras), ReflectanceError
        places = checked_array(self.light_positions, (count, 3), "light_positions", wrong, finite=wrong)
        light = checked_array(self.light, (count,), "light", wrong, kind=int)
        if (light < 0).any():
            raise ReflectanceError(f"light is {light.min()} at least, expected 0 or more")
        vars(self).update(cameras=cameras, light_positions=places, light=light)

    @property
    def camera_positions(self) -> FloatArray:
        """(J, 3) centres of projection in mm."""
        return camera_centers(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)


def rig_of_head_poses(
    rotations: ArrayLike, translations: ArrayLike, intrinsics: ArrayLike, *, view: ArrayLike, flash: ArrayLike
) -> CaptureRig:
    """Return the rig in which each flash is at the place of a camera.

    A head pose maps points of the face into camera c, x_cam = R_c x + t_c; seen from the face, the camera is
    turned by R_c^T and is at -R_c^T t_c. Picture j is taken by camera view[j], lit by the flash at camera
    flash[j] (Han, Wang, Xu, supplement, Eq. 1). Raises `ReflectanceError` when shapes disagree, a matrix is
    no rotation, or a number refers to no camera.

    Parameters
    ----------
    rotations, translations : (C, 3, 3), (C, 3) array_like of float
        R, proper, and t in mm.
    intrinsics : (3, 3) or (C, 3, 3) array_like of float
        Pixels from camera coordinates.
    view, flash : (J,) array_like of int
        Numbers of cameras.
    """
    turn = checked_array(rotations, ("C", 3, 3), "rotations", ReflectanceError)
    shift = checked_array(translations, turn.shape[:2], "translations", ReflectanceError)
    for number, rotation in enumerate(turn):
        if not is_rigid(compose(rotation, np.zeros(3)), 1e-4):
            said = f"head pose {number} has no proper rotation, R R^T = 1 and det R = 1"
            raise ReflectanceError(f"{said}: {rotation.tolist()}")
    seen_by = checked_array(view, ("J",), "view", ReflectanceError, kind=int)
    numbers = [seen_by, checked_array(flash, seen_by.shape, "flash", ReflectanceError, kind=int)]
    for name, index in zip(("view", "flash"), numbers, strict=True):
        if len(index) and not (index.min() >= 0 and index.max() < len(turn)):
            raise ReflectanceError(f"{name} reaches {index.min()} to {index.max()} of {len(turn)} poses")
    inner = np.broadcast_to(np.asarray(intrinsics, float), turn.shape)
    cameras = inner @ np.concatenate([turn, shift[:, :, None]], axis=2)
    centers = -np.einsum("cji,cj->ci", turn, shift)
    return CaptureRig(cameras[numbers[0]], centers[numbers[1]], numbers[1])


_LEAST_SIGMA = np.sqrt(SMALLEST)
"""Its square's inverse must be a number."""
VIEW_COSINE = 0.1
"""n.v must be above this."""
_POSITION_SIGMA_PX = 0.3
"""Standard deviation of where a vertex is in the picture, along each axis: where pixels differ, a vertex's
sigma is larger."""


@dataclass(frozen=True)
class VertexSamples:
    """Observations of V vertices in J pictures; `ReflectanceError` for other shapes or invalid ones."""

    observed_linear: FloatArray
    """(J, V, 3): linear, negative where noise made it so; 0 where not valid."""
    sigma: FloatArray
    """(J, V, 3): standard deviation, > 0 where valid."""
    valid: BoolArray
    """(J, V, 3): seen, lit, neither saturated nor missing."""
    lobes: FloatArray
    """(J, V, 4): radiance of unit albedo and unit weights, see `point_light_lobes`; 0 in cast shadow."""
    light: IntArray
    """(J,): number of the flash."""
    slopes: FloatArray | None = None
    """(J, V, 4): how lobes change as the normal tilts, see `lobe_slopes`; None: normals are right."""
    normal_spread: FloatArray | None = None
    """(V,): root mean square angle, in radians, between a vertex's normal and those of its triangles."""
    form_factors: sparse.csr_matrix | None = None
    """(V, V): of light from the mesh onto itself; None: none does, as in renderings of direct light alone."""

    def __post_init__(self) -> None:
        shape = checked_array(self.observed_linear, ("J", "V", 3), "observed_linear", ReflectanceError).shape
        lobed = (*shape[:2], 4)
        for name, expected in (
            ("observed_linear", shape),
            ("sigma", shape),
            ("valid", shape),
            ("lobes", lobed),
            ("light", shape[:1]),
            ("slopes", lobed),
            ("normal_spread", shape[1:2]),
        ):
            if (value := getattr(self, name)) is not None:
                kind = {"valid": bool, "light": int}.get(name, float)
                array = checked_array(value, expected, name, ReflectanceError, kind=kind)
                object.__setattr__(self, name, np.ascontiguousarray(array))
        if self.form_factors is not None and self.form_factors.shape != 2 * shape[1:2]:
            raise ReflectanceError(f"form_factors is {self.form_factors.shape}, expected {2 * shape[1:2]}")
        observed, sigma, valid, light = self.observed_linear, self.sigma, self.valid, self.light
        if (light < 0).any():
            raise ReflectanceError(f"light is {light.min()} at least, expected 0 or more")
        bad = valid & ~(np.isfinite(observed) & np.isfinite(sigma) & (sigma > _LEAST_SIGMA))
        bad |= valid & ~np.isfinite(self.lobes).all(-1, keepdims=True)
        if not all(one is None or all_finite(one) for one in (self.slopes, self.normal_spread)):
            raise ReflectanceError("slopes and normal_spread must be finite; leave them out if unknown")
        if bad.any():
            pair, vertex, _ = np.argwhere(bad)[0]
            raise ReflectanceError(
                f"vertex {vertex} is said to be valid in picture {pair}, but observation, sigma or lobes are "
                f"not finite or sigma is not above {_LEAST_SIGMA:g}: "
                f"{observed[pair, vertex]}, {sigma[pair, vertex]}"
            )
        object.__setattr__(self, "observed_linear", np.where(valid, observed, 0.0))

    @property
    def pair_count(self) -> IntArray:
        """(V,) pictures with an observation of a vertex."""
        return np.asarray(self.valid.any(-1).sum(0), int)

    def of_pairs(self, pairs: ArrayLike) -> Self:
        """Return the samples of some pictures: indices, or a mask (J,)."""
        names = ("observed_linear", "sigma", "valid", "lobes", "light", "slopes")
        arrays = {name: array for name in names if (array := getattr(self, name)) is not None}
        return replace(self, **{name: array[np.asarray(pairs)] for name, array in arrays.items()})

    def bounced_light(self, albedo: FloatArray) -> FloatArray:
        """Return light (J, V, 3) between vertices of one `albedo` (3,), in units of the diffuse lobes D.

        B = albedo F (D + B), F the form factors, D that of one picture a flash.
        """
        if self.form_factors is None or not albedo.any():
            return np.zeros((*self.lobes.shape[:2], 3))
        _, first, number = np.unique(self.light, return_index=True, return_inverse=True)
        direct = self.lobes[first, :, 0].T
        result = np.zeros((3, *direct.shape))
        for _ in range(4):  # bounces; the fifth is below 1 % of the first even on pale skin in creases
            for k in range(3):
                result[k] = albedo[k] * (self.form_factors @ (direct + result[k]))
        return np.ascontiguousarray(result.T[number])

    def turned_lobes(self, tilt: ArrayLike) -> FloatArray:
        """Return the lobes (J, V, 4) of normals tilted by `tilt` (V, 2), see `ReflectanceFit.tilt`."""
        if self.slopes is None:
            return self.lobes
        turned = np.zeros(self.lobes.shape)
        rows, angle = np.arange(self.lobes.shape[1]), np.nan_to_num(np.asarray(tilt, float))
        turn_lobes(self.lobes, self.slopes, angle, rows, turned)
        return turned


def sample_vertices(
    olat: OlatImages,
    rig: CaptureRig,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    reference_distance_mm: float | None = None,
) -> VertexSamples:
    """Return what pictures show of vertices, where the camera sees and the flash lights them.

    Pixels are interpolated bilinearly, a channel only where all four are valid. Sigma is that of independent
    pixels and, where the four differ by more than their noise, of not knowing the position better. Hidden
    vertices and cast shadows are found by rays against the mesh. Vertices nearer than 1.5 pixels to an edge
    of the surface are left out. Raises `ValueError` for other normals or distances, `ReflectanceError` when
    there are not as many cameras as pictures, the mesh is none, or it or normals are not finite or unit.

    Parameters
    ----------
    olat : OlatImages
        J pictures.
    rig : CaptureRig
        Their cameras and flashes, in the frame of the mesh.
    vertices, faces : (V, 3) array_like of float, (F, 3) array_like of int
        Millimetres.
    normals : (V, 3) array_like of float, optional
        Unit; those of the mesh when omitted. A vertex whose normal is 0 is never seen.
    reference_distance_mm : float, optional
        Distance at which light has fallen off to 1, with its square; no falloff when omitted.
    """
    if reference_distance_mm is not None and not 0 < reference_distance_mm < math.inf:
        raise ValueError(f"reference_distance_mm is {reference_distance_mm}, expected > 0 and finite")
    if len(rig) != len(olat):
        raise ReflectanceError(f"there are {len(olat)} pictures but {len(rig)} cameras in the rig")
    xyz, index, normal = checked_surface(vertices, faces, normals)
    views = xyz, normal, rig.camera_positions, rig.light_positions
    lobes, lobe_slopes = lobes_and_slopes(*views, reference_distance_mm)
    shape = (len(olat), len(xyz), 3)
    observed, variance, valid = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)
    visibility = VertexVisibility(xyz, index, normal)
    cameras, camera = np.unique(rig.cameras, axis=0, return_inverse=True)
    flashes, flash = np.unique(rig.light_positions, axis=0, return_inverse=True)
    seen = [visibility.seen(one, VIEW_COSINE) for one in cameras]
    illuminated = [visibility.illuminated(one) for one in flashes]
    camera, flash = camera.ravel(), flash.ravel()  # NumPy 2.0 gives them the axes of the rig
    lobes *= np.stack([visibility.reached(one) for one in flashes])[flash, :, None]
    for j, (view, light) in enumerate(zip(camera, flash, strict=True)):
        pixels, _ = project(cameras[view], xyz)
        usable = seen[view] & illuminated[light] & (lobes[j, :, 0] > 0)
        around, share = pixels_around(olat.valid.shape[1:3], pixels)
        four, noise = (image[j][around].astype(float) for image in (olat.linear, olat.sigma))
        valid[j] = (usable & share.any(0))[:, None] & olat.valid[j][around].all(0)
        slopes = (four[[1, 2]] + four[3] - four[0] - four[[2, 1]]) / 2
        # Each slope's own noise has the mean variance of the four.
        steep = np.maximum((slopes**2).sum(0) - 2 * (noise**2).mean(0), 0)
        spread = ((share[..., None] * noise) ** 2).sum(0) + _POSITION_SIGMA_PX**2 * steep
        observed[j], variance[j] = np.where(valid[j], [(share[..., None] * four).sum(0), spread], 0.0)
    # Root mean square angles between normals of vertices and of their triangles, by area.
    across, corners = face_cross_products(xyz, index), index.ravel()
    cosine = np.einsum("fkc,fc->fk", normal[index], normalized(across))
    angle, weight = np.arccos(np.clip(cosine, -1, 1)), np.repeat(norms(across), 3)
    square = np.bincount(corners, weight * angle.ravel() ** 2, len(xyz))
    normal_spread = np.sqrt(square / np.maximum(np.bincount(corners, weight, len(xyz)), SMALLEST))
    return VertexSamples(
        *(observed, np.sqrt(variance), valid, lobes, rig.light, lobe_slopes, normal_spread),
        visibility.form_factors(),
    )
