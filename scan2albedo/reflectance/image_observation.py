"""Colours of one image at the vertices of a face, its geometry and pose being known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.environment_shading import HARMONICS, LightResponse, light_response, unit_vectors
from scan2albedo.reflectance.lobe_coefficients import Lobe


@dataclass(frozen=True)
class ImageObservation:
    """Radiance of V vertices in one image, with their normals and the directions to the camera.

    Raises `ReflectanceError` when a seen vertex has no finite colour or no unit vectors, nothing is seen, it
    is black there, or its transfer is not finite or lets no light come; `ValueError` when shapes disagree.
    """

    observed_linear: ArrayLike
    """(V, 3): linear colour at each vertex, of any exposure; unused where not seen."""
    normals: ArrayLike
    toward_camera: ArrayLike
    """`normals`, `toward_camera`: (V, 3): unit vectors in one frame, the one that light is wanted in; unused
    where not seen."""
    seen: ArrayLike
    """(V,): vertices that count: not occluded, skin, not saturated."""
    transfer: LightResponse | None = None
    """Of the V vertices with the shadows that the surface casts on itself, from `light_transfer`; none are
    cast when omitted. Unused where not seen."""

    def __post_init__(self) -> None:
        seen = np.asarray(self.seen)
        if seen.dtype != np.bool_ or seen.ndim != 1:
            raise ValueError(f"seen must be bool (V,), got {seen.dtype} {seen.shape}")
        for name in ("observed_linear", "normals", "toward_camera"):
            array = np.asarray(getattr(self, name), np.float64)
            if array.shape != (len(seen), 3):
                raise ValueError(f"{name} must have shape ({len(seen)}, 3), got {array.shape}")
            bad = seen & ~np.isfinite(array).all(1)
            if bad.any():
                raise ReflectanceError(
                    f"{name} of vertex {int(np.flatnonzero(bad)[0])} holds NaN or infinite values "
                    f"({bad.sum()} vertices); take such vertices out of `seen`"
                )
            object.__setattr__(self, name, array)
        for name in ("normals", "toward_camera"):
            unit_vectors(np.where(seen[:, None], np.asarray(getattr(self, name)), (0.0, 0.0, 1.0)), name)
        object.__setattr__(self, "seen", seen)
        if not seen.any():
            raise ReflectanceError("the image shows no vertex of the face; check its mask and the pose")
        if not self.brightness > 0:
            raise ReflectanceError(
                f"the image is black where the face is (mean {self.brightness:.3g}); check exposure and pose"
            )
        if self.transfer is not None:
            _check_transfer(self.transfer, seen)

    @property
    def brightness(self) -> float:
        """Mean colour of the seen vertices."""
        return float(np.asarray(self.observed_linear)[np.asarray(self.seen)].mean())

    def response(self, used: ArrayLike, lobe: Lobe = "tilted") -> LightResponse:
        """Return how seen vertices `used` (U,) respond to light: rows of the transfer, or without shadows.

        `lobe` applies without a transfer, see `light_response`; a transfer has its own.
        """
        rows = np.asarray(used)
        if self.transfer is not None:
            return LightResponse(self.transfer.diffuse[rows], self.transfer.specular[rows])
        return light_response(np.asarray(self.normals)[rows], np.asarray(self.toward_camera)[rows], lobe=lobe)


def _check_transfer(transfer: LightResponse, seen: BoolArray) -> None:
    shapes = (len(seen), HARMONICS), (len(seen), 3, HARMONICS)
    if (transfer.diffuse.shape, transfer.specular.shape) != shapes:
        raise ValueError(
            f"transfer has shapes {transfer.diffuse.shape} and {transfer.specular.shape}, expected "
            f"{shapes[0]} and {shapes[1]}"
        )
    rows = np.concatenate([transfer.diffuse[seen], transfer.specular[seen].reshape(seen.sum(), -1)], axis=1)
    bad = ~np.isfinite(rows).all(1)
    if bad.any():
        raise ReflectanceError(
            f"the transfer of vertex {int(np.flatnonzero(seen)[bad][0])} holds NaN or infinite values "
            f"({bad.sum()} vertices); take such vertices out of `seen`"
        )
    if not rows.any():
        raise ReflectanceError(
            "the transfer lets no light reach any vertex that is seen; check that normals point out of the "
            "surface and that no other surface encloses it"
        )
