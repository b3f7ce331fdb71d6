"""Details of a face's albedo: what a photograph, divided by shading, shows beyond a model's albedo."""

from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import EPSILON, ArrayLike, BoolArray, FloatArray, IntArray
from scan2albedo.geometry.fields import surface_diffusion
from scan2albedo.geometry.mesh import edges_with_faces
from scan2albedo.reflectance.environment_shading import diffuse_response, shading_gradient
from scan2albedo.reflectance.image_fit import common_vertices
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.photograph import ImageObservation
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance, among_all

SHAPE_ERROR_MM = 12.0
"""Length over which errors of a shape are alike. An error of the normals goes with one of positions, of this
length times the angle: 2 mm along each axis in shapes from landmarks."""
_BANDS = {4.0: 0.05, 8.0: 0.02, 16.0: 0.01, 32.0: 0.01}
"""Standard deviations in mm of the blurs that divide the residual into bands, and of the logarithm of the
light's error in each, from wrong normals, shadows and interreflection; what is wider than all is light."""
_GREY = 0.9
"""Share of the variance of the light's error that is common to the three channels."""
_LEAST_OPEN = 0.4
"""Least share of the light around that a fold leaves to a vertex that counts."""
_LEAST_LIGHT = 0.2
"""Least light on a vertex that counts, over the median."""
_LEAST_DIFFUSE = 0.5
"""Least share of a counting vertex's observed light that is no highlight: its errors look like albedo."""


@dataclass(frozen=True)
class ShadingDivided:
    """An image divided by what a reflectance sends back under a light."""

    log_ratio: FloatArray
    """(V, 3): logarithm of the observed over the predicted diffuse light, highlights taken off; 0 where not
    seen."""
    usable: BoolArray
    """(V,): where it depends on the albedo."""
    illuminated: BoolArray
    """(V,): where enough light arrives that predictions can be compared; contains `usable`."""
    highlight_share: FloatArray
    """(V, 3): of the predicted light; 0 where not seen."""
    log_whole: FloatArray
    """(V, 3): logarithm of the observed over the whole predicted light; 0 where not seen."""
    by_tilt: FloatArray
    """(V, 3, 3): covariance of the logarithms of the channels' light by a normal's tilt of one radian; 0
    where not usable."""
    log_received: FloatArray
    """(V, 3): logarithm of the light that arrives; NaN where not seen."""

    @classmethod
    def from_observation(
        cls,
        observation: ImageObservation,
        model: MorphableReflectanceModel,
        reflectance: VertexReflectance,
        light: FloatArray,
    ) -> Self:
        """Divide an image by a reflectance under a light (81, 3)."""
        used = common_vertices(observation, model)
        response = observation.response(used)
        received = response.diffuse @ light
        made = response.shade(reflectance.chosen(used), light)
        diffuse, highlight = made.diffuse_linear, made.specular_linear
        observed = observation.observed_linear[used]
        floor = EPSILON + 1e-3 * np.median(diffuse)
        spread = partial(among_all, used, len(model.known))

        def log_ratio(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
            ratio = np.log(np.maximum(numerator, floor) / np.maximum(denominator, floor))
            # Larger residuals are holes, hair or other surfaces.
            return spread(np.clip(ratio, -1.5, 1.5), 0.0)

        free = diffuse_response(observation.normals[used])[:, 0]
        open_share = response.diffuse[:, 0] / np.maximum(free, EPSILON)
        usable, illuminated = np.zeros((2, len(model.known)), bool)
        bright = received.min(1) > _LEAST_LIGHT * np.median(received)
        illuminated[used] = bright & (open_share > _LEAST_OPEN)
        usable[used] = illuminated[used] & (observed - highlight > _LEAST_DIFFUSE * observed).all(1)
        by_normal, _ = shading_gradient(
            reflectance.chosen(used), observation.normals[used], observation.toward_camera[used], light
        )
        slopes = by_normal / np.maximum(diffuse + np.maximum(highlight, 0), floor)[..., None]
        by_tilt = np.where(usable[used, None, None], slopes @ slopes.transpose(0, 2, 1) / 2, 0.0)
        return cls(
            log_ratio=log_ratio(observed - highlight, diffuse),
            usable=usable,
            illuminated=illuminated,
            highlight_share=spread(np.clip(highlight / np.maximum(diffuse + highlight, floor), 0, 1), 0.0),
            log_whole=log_ratio(observed, diffuse + highlight),
            by_tilt=spread(by_tilt, 0.0),
            log_received=spread(np.log(np.maximum(received, floor))),
        )

    def steepness(self) -> float:
        """Return by what part the light changes where a normal tilts by one radian, root mean square."""
        tilt = np.trace(self.by_tilt[self.usable], axis1=1, axis2=2)
        return float(np.sqrt(np.median(tilt) / 3)) if len(tilt) else 0.0

    def left_over(self, field: FloatArray | float = 0.0) -> FloatArray:
        """Return the logarithm (V, 3) of the observed over the predicted light with details (V, 3)."""
        share = self.highlight_share
        return self.log_whole - np.log(share + (1 - share) * np.exp(field))

    def by_shift(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """Return (V, 3, 3) as `by_tilt`, by a shift of positions (V, 3) of one unit along each axis."""
        edges, _ = edges_with_faces(faces)
        ends = edges[np.isfinite(self.log_received[edges]).all((1, 2))].T
        entry, shape = (ends.ravel(), np.tile(np.arange(ends.shape[1]), 2)), (len(vertices), ends.shape[1])
        at = sparse.csr_matrix((np.ones(ends.size), entry), shape=shape)
        change, length = (values[ends[0]] - values[ends[1]] for values in (self.log_received, vertices))
        steep = at @ (2 * change[:, :, None] * change[:, None, :]).reshape(-1, 9)
        square = np.where(self.usable, np.maximum(at @ (length**2).sum(1), EPSILON), np.inf)
        return (steep / square[:, None]).reshape(-1, 3, 3)


def detail_field(
    divided: ShadingDivided, vertices: ArrayLike, faces: IntArray, normal_error: float = 0.0
) -> FloatArray:
    """Return the logarithm (V, 3) of the factor by which the albedo differs from the model's.

    Blurs of growing width divide the residual of the photograph into bands. In each, with R the residual's
    covariance (3, 3) over the channels and S that of the light's error, the best linear estimate of the
    albedo's part is (R - S) R^-1 times the residual (Wiener); R - S is cut at 0. Normals that are off by an
    angle (radians), and positions with them, add an equal part of what that does to the light to S of each
    band. Both are means over the usable vertices around each one, within the last blur. What is wider than
    that is left to the light, and the field fades far from usable vertices (V, 3), mm.
    """
    usable = divided.usable
    field = np.zeros_like(divided.log_ratio)
    if not usable.any():
        return field
    xyz = np.asarray(vertices, float)
    blurs = [surface_diffusion(xyz, faces, width) for width in _BANDS]
    near = np.maximum(blurs[-1](usable.astype(float)), EPSILON)

    def around(covariance: FloatArray) -> FloatArray:
        return blurs[-1](np.where(usable[:, None, None], covariance, 0.0)) / near[:, None, None]

    wrong = divided.by_tilt + (SHAPE_ERROR_MM**2 * divided.by_shift(xyz, faces) if normal_error else 0.0)
    tilted = normal_error**2 / len(_BANDS) * around(wrong)
    cover = blurs[0](usable.astype(float))
    coarser = blurs[0](np.where(usable[:, None], divided.log_ratio, 0.0)) / np.maximum(cover, 1e-6)[:, None]
    finer = np.where(usable[:, None], divided.log_ratio, coarser)
    for blur, error in zip(blurs, _BANDS.values(), strict=True):
        coarser = coarser if blur is blurs[0] else blur(finer)
        band = finer - coarser
        total = around(band[:, :, None] * band[:, None, :]) + EPSILON * np.eye(3)
        light = error**2 * (_GREY * np.ones((3, 3)) + (1 - _GREY) * np.eye(3)) + tilted
        value, vector = np.linalg.eigh(total)
        size, turned = np.sqrt(np.maximum(value, EPSILON))[:, None], vector.transpose(0, 2, 1)
        root, inverse = vector * size @ turned, vector / size @ turned
        kept, axis = np.linalg.eigh(np.eye(3) - inverse @ light @ inverse)
        gain = root @ (axis * np.maximum(kept, 0.0)[:, None]) @ axis.transpose(0, 2, 1) @ inverse
        field += np.einsum("vij,vj->vi", gain, band)
        finer = coarser
    return field * np.clip(cover, 0.0, 1.0)[:, None]
