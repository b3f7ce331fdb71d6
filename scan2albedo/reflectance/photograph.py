"""`ImageObservation`: colours of one image at the vertices of a face; how to get it from a photograph."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    NDArray,
    checked_array,
    dots,
    finite_rows,
)
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, normalized_cameras, project
from scan2albedo.geometry.rays import RayCaster, blocks, each_block
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance import environment_shading as shading, vertex_visibility as sight
from scan2albedo.reflectance.environment_shading import LightResponse, light_response, unit_vectors
from scan2albedo.reflectance.olat import OlatOptions, linear_values, picture_values
from scan2albedo.reflectance.vertex_reflectance import BLOCK, EXPONENTS
from scan2albedo.reflectance.vertex_samples import VIEW_COSINE
from scan2albedo.reflectance.vertex_visibility import RAY_OFFSET_MM


def light_transfer(
    vertices: ArrayLike,
    faces: ArrayLike,
    normals: ArrayLike,
    toward_camera: ArrayLike,
    *,
    directions: int = 1024,
) -> LightResponse:
    """Return how vertices respond to light when the surface casts shadows on itself.

    With V(w) = 1 where a ray from the vertex along w leaves the surface, and K the diffuse lobe
    max(0, n.w) / pi or a highlight's (s + 2) / (8 pi) max(0, n.h)^s, n.w > 0,

        T_lm = integral over the sphere of V(w) K(w) Y_lm(w) dw.

    Sums Q over directions approximate the integral. Without shadow the diffuse response A is known in closed
    form; with h the hidden share of the lobe, sums therefore enter only as far as shadow reaches:

        T = Q[V K] + (1 - h) (A - Q[K]).

    Raises `ReflectanceError` when the mesh is none or not finite, or a vector is not a unit vector;
    `ValueError` when shapes disagree, or the number of directions is out of range.

    Parameters
    ----------
    vertices, faces : (V, 3) array_like of float, (F, 3) array_like of int
        Millimetres, of everything that casts shadows.
    normals, toward_camera : (V, 3) array_like of float
        Unit vectors n and v. A vertex whose normal is 0 receives nothing.
    directions : int
        Of the sums, a Fibonacci spiral over the sphere; 64 to 100,000.

    Notes
    -----
    After Sloan, Kautz, Snyder, "Precomputed radiance transfer", SIGGRAPH 2002. 1,024 directions leave errors
    of 0.5 % in the diffuse light that a face receives and of 1 to 3 % in the highlights
    (`python tools/bench photographs/transfer`). Light that the surface reflects onto itself is left out.
    """
    xyz, index, n = sight.checked_surface(vertices, faces, normals)
    n, v = normalized(n), checked_array(toward_camera, n.shape, "toward_camera")
    if not 64 <= directions <= 100_000:
        raise ValueError(f"directions must be 64 to 100000, got {directions}")
    bare = np.asarray(~n.any(1))
    n[bare] = (0.0, 0.0, 1.0)  # placeholders
    v = unit_vectors(np.where(bare[:, None], n, v), "toward_camera")
    toward = distant_directions(directions)
    weighted = harmonics(toward, shading.ORDER) * (4 * np.pi / directions)
    visible = ShadowMap(RayCaster(xyz, index), xyz, n, RAY_OFFSET_MM).table(toward).visibility
    diffuse = shading.diffuse_response(n)
    specular = np.zeros((len(xyz), len(EXPONENTS), weighted.shape[1]))

    def sum_up(block: slice) -> None:
        reached, cosine = visible[:, block].T > 0, n[block] @ toward.T
        # Of vertices with shadow, from those without and max(0, n.w) (B, D). The first harmonic is constant,
        # so that its coefficient gives the lit share of the lobe.
        some = np.flatnonzero((~reached & (cosine > 0)).any(1))
        facing = np.maximum(cosine[some], 0)
        whole = facing @ weighted / np.pi
        part = np.where(reached[some], facing, 0.0) @ weighted / np.pi
        rows = block.start + some
        diffuse[rows] = part + part[:, :1] / whole[:, :1] * (diffuse[rows] - whole)
        n_v = dots(n[block], v[block])[:, None]
        half = np.sqrt(np.maximum(2 + 2 * (v[block] @ toward.T), 1e-12))
        # A surface that faces away from the camera sends it no highlights.
        n_h = np.where(reached & (cosine > 0) & (n_v > 0), (cosine + n_v) / half, 0.0)
        for k, s in enumerate(EXPONENTS):
            specular[block, k] = (s + 2) / (8 * np.pi) * n_h**s @ weighted

    each_block(sum_up, blocks(len(xyz), BLOCK))
    diffuse[bare] = 0.0
    specular[bare] = 0.0
    return LightResponse(diffuse, specular)


@dataclass(frozen=True)
class ImageObservation:
    """Radiance of V vertices in one image, with their normals and the directions to the camera.

    Raises `ReflectanceError` when a seen vertex has no finite colour or no unit vectors, nothing is seen, it
    is black there, or its transfer is not finite or lets no light come; `ValueError` when shapes disagree.
    """

    observed_linear: FloatArray
    """(V, 3): linear colour at each vertex, of any exposure; unused where not seen."""
    normals: FloatArray
    toward_camera: FloatArray
    """`normals`, `toward_camera`: (V, 3): unit vectors in one frame, the one that light is wanted in; unused
    where not seen."""
    seen: BoolArray
    """(V,): vertices that count: not occluded, skin, not saturated."""
    transfer: LightResponse | None = None
    """Of the V vertices with the shadows that the surface casts on itself, from `light_transfer`; none are
    cast when omitted. Unused where not seen."""

    def __post_init__(self) -> None:
        seen = checked_array(self.seen, ("V",), "seen", kind=bool)

        def require_finite(name: str, rows: FloatArray) -> None:
            """Raise ReflectanceError where numbers (N, ...) of the N seen vertices are not."""
            bad = ~finite_rows(rows)
            if bad.any():
                raise ReflectanceError(
                    f"{name} of vertex {np.flatnonzero(seen)[bad][0]} holds NaN or infinite values "
                    f"({bad.sum()} vertices); take such vertices out of `seen`"
                )

        for name in ("observed_linear", "normals", "toward_camera"):
            array = checked_array(getattr(self, name), (len(seen), 3), name)
            require_finite(name, array[seen])
            object.__setattr__(self, name, array)
        for name in ("normals", "toward_camera"):
            unit_vectors(np.where(seen[:, None], getattr(self, name), (0.0, 0.0, 1.0)), name)
        object.__setattr__(self, "seen", seen)
        if not seen.any():
            raise ReflectanceError("the image shows no vertex of the face; check its mask and the pose")
        if not self.observed_linear[seen].mean() > 0:
            raise ReflectanceError("the image is black where the face is; check exposure and pose")
        if self.transfer is None:
            return
        count, size = len(seen), shading.HARMONICS
        diffuse = checked_array(self.transfer.diffuse, (count, size), "diffuse of the transfer")
        specular = checked_array(self.transfer.specular, (count, 3, size), "specular of the transfer")
        rows = np.concatenate([diffuse[seen], specular[seen].reshape(seen.sum(), -1)], axis=1)
        require_finite("the transfer", rows)
        if not rows.any():
            raise ReflectanceError(
                "the transfer lets no light reach any vertex that is seen; check that normals point out of "
                "the surface and that no other surface encloses it"
            )

    def response(self, used: ArrayLike) -> LightResponse:
        """Return how seen vertices `used` (U,) respond to light: rows of the transfer, or without shadows."""
        rows = np.asarray(used)
        if self.transfer is not None:
            return LightResponse(self.transfer.diffuse[rows], self.transfer.specular[rows])
        return light_response(self.normals[rows], self.toward_camera[rows])


def observe_photograph(
    image: NDArray,
    camera: ArrayLike,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    gamma: float = OlatOptions.gamma,
    saturation: float = OlatOptions.saturation,
) -> ImageObservation:
    """Return a face's vertices in a photograph, where the camera sees them well, with their transfer.

    A vertex counts when nothing hides it, it is not seen at too flat an angle nor within 1.5 pixels of an
    edge in depth, and the four pixels around it are skin, finite and not saturated in any channel. Their
    light, value^gamma, is interpolated. The observation is in the frame of the mesh; 3,700 vertices take
    about a second. Raises `ReflectanceError` when no vertex counts (names the step at which the last ones
    were lost), or image, camera or mesh cannot be used; `ValueError` for other shapes or options.

    Parameters
    ----------
    image : (H, W, 3) array
        Displayed values: floats, white = 1, or integers of 8 or 16 bits; NaN where there is nothing.
    camera : (3, 4) array_like of float
        Projection matrix: pixels (column, row), centres at integers, from points in mm.
    vertices, faces : (V, 3) array_like of float, (F, 3) array_like of int
        Millimetres, of all that hides vertices or casts shadows.
    normals : (V, 3) array_like of float, optional
        Unit; those of the mesh when omitted. A vertex whose normal is 0 is never seen.
    mask : (H, W) array_like of bool, optional
        True on skin; all pixels when omitted.
    gamma, saturation : float
        See `OlatOptions`.
    """
    OlatOptions(gamma=gamma, saturation=saturation)  # refuses what they must not be
    xyz, index, normal = sight.checked_surface(vertices, faces, normals)
    normal = normalized(normal)
    matrix = checked_array(camera, (3, 4), "camera")
    with errors_of("the camera cannot be used", ReflectanceError, ValueError):
        matrix = normalized_cameras(matrix[None])[0]
    if np.ndim(image) != 3 or np.shape(image)[2] != 3 or np.size(image) == 0:
        raise ValueError(f"image is {np.shape(image)}, expected (H, W, 3)")
    values = picture_values(np.asarray(image), "the image", saturation)
    finite = finite_rows(values)
    values = np.where(finite[..., None], values, 0.0)
    region = np.ones(finite.shape, bool) if mask is None else mask
    skin = checked_array(region, finite.shape, "mask", kind=bool)
    linear = linear_values(values, gamma).astype(np.float32)
    toward = normalized(camera_centers(matrix) - xyz)
    seen = sight.VertexVisibility(xyz, index, normal).seen(matrix, VIEW_COSINE)
    pixels, _ = project(matrix, xyz)
    steps = {
        "inside the picture": np.ones_like(skin),
        "on the mask": skin,
        "with finite colours": skin & finite,
        "not saturated": skin & finite & ~(values >= saturation).any(-1),
    }
    around, share = sight.pixels_around(skin.shape, pixels)
    counted = {name: seen & share.any(0) & valid[around].all(0) for name, valid in steps.items()}
    found = counted["not saturated"]
    if not found.any():
        left = ", ".join(f"{some.sum()} {name}" for name, some in counted.items())
        raise ReflectanceError(
            f"no vertex of {len(seen)} can be used: {seen.sum()} are seen by the camera, {left}; check "
            "camera, mask and exposure in this order"
        )
    observed = np.where(found[:, None], (share[..., None] * linear[around]).sum(0), np.nan)
    return ImageObservation(observed, normal, toward, found, light_transfer(xyz, index, normal, toward))
