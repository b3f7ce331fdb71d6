"""The light on a scan beyond its fitted face: what was found on the face goes on over the scan's surface."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import logit

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.albedo.result import shade_image
from scan2albedo.core import GeometryImage, RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.materials import materials_beyond_chart
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.fields import Field, filled_over_mesh
from scan2albedo.geometry.mesh import edges_with_faces, median_edge, neighbour_mean, thinned, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv, scan_colors
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.unlit.face_features import FLOOR

OUTSIDE_CONFIDENCE = 0.5
"""Relative to the face: beyond the model the light is that of its lamps on the scan's own, rougher shape."""
DARKEST = 0.1
"""Least light that divides, as a part of the usual: less makes noise bright, more leaves deep shadows dark
(`tools/bench/unlit.py`)."""
SURE_HAIR = 0.5
"""Where nothing is hair more surely, there is none."""
_SPACING_MM = 2.5
"""Distance between the scan's vertices with which the light beyond the face is found."""
_FAR_MM = 25.0
"""Over so much of the surface what was found at the face's rim fades to a part of 1/e."""
_EVEN_MM = 10.0
"""Over so much of the surface skin's albedo, and the light on hair, change little."""
_OWN = 0.2
"""Deviation of skin's log albedo beyond the face: of that the model's light leaves, half is its own, and the
less the more it is beyond this."""
_WHITE = 1.4
"""By so much is log albedo at most above that of skin, on average: white cloth is four times as bright."""
_COLORED_FACES = 100_000
"""Faces of a scan whose colours are looked up at most."""


@dataclass(frozen=True)
class LightBeyond:
    """What is known of places on a scan, were they beyond the face."""

    log_light: FloatArray
    """(N, 3)."""
    taken_off: FloatArray
    """(N,): how surely the light is taken off, at most `OUTSIDE_CONFIDENCE`."""
    skin: FloatArray
    """(N, 3): log albedo that is expected of skin."""
    steepness: FloatArray
    """(N,): by how much log light changes to the next vertex; 0 where it is not skin."""
    hair_log_odds: FloatArray
    """(N,): of hair, for a log brightness of 0."""
    hair_by_brightness: float
    """Weight of a place's own log brightness in its log odds of hair."""
    detail: float
    """Usual deviation of skin's log albedo from around."""

    def interpolated(self, interpolate: Callable[[FloatArray], FloatArray]) -> Self:
        """Return the same of other places, whose values are linear in those of these."""
        return replace(
            self,
            log_light=interpolate(self.log_light),
            taken_off=interpolate(self.taken_off),
            skin=interpolate(self.skin),
            steepness=interpolate(self.steepness),
            hair_log_odds=interpolate(self.hair_log_odds),
        )


class SurfaceLight:
    """A scan's surface with few vertices (N,), on the face and beyond it: its colours and its light.

    The light beyond the face is a base (the usual one, or that of the estimate's lamps on the scan's own
    shape) plus an offset o, the least of

        sum_ij w_ij |o_i - o_j|^2 + sum_i p |o_i|^2 + sum_i d_i |o_i - r_i|^2

    over the edges ij of the mesh, equal to that of the chart on the face (a screened membrane). Its links w
    hold where both ends are skin, or both are not. Where light is taken off everywhere, r is what the colour
    of skin differs by from the expected; d is small for detail and large for outlines of shadows.
    """

    def __init__(
        self,
        scan: RawScan,
        fitted: FittedFace,
        estimate: AlbedoEstimate,
        log_light: FloatArray,
        on_chart: tuple[FloatArray, FloatArray],
        brightness: float,
    ) -> None:
        """Look at the scan.

        `log_light` (H, W, 3) is that of the chart, `on_chart` the places (V, 2) of the scan's vertices on it
        and how much (V,) they belong to the face, `brightness` the light of which brightness is kept.
        """
        image = estimate.image
        self._vertices = transform_points(fitted.model_from_scan, scan.vertices)
        thin = thinned(self._vertices, scan.faces, _SPACING_MM)
        if len(thin.faces) == 0:
            thin = thinned(self._vertices, scan.faces, 0.0)
        self._points, self._faces, count = thin.vertices, thin.faces, len(thin.vertices)
        normals = vertex_normals(self._points, self._faces)
        self._edge_mm = median_edge(self._points, self._faces) or 1.0
        self._mean = neighbour_mean(count, self._faces)
        nearest = cKDTree(self._vertices).query(self._points)[1]
        pixels = pixels_from_uv(on_chart[0][nearest], image.shape)
        inside = on_chart[1][nearest]
        self._brightness = brightness
        self._chart = bilinear(log_light, pixels)
        self._on_face = inside >= 0.5
        self._log_color = self._mean_log_color(scan)
        caster = RayCaster(self._points, self._faces) if estimate.casts_shadows else None
        shading = shade_image(
            GeometryImage(self._points[None], normals[None], np.ones((1, count), bool)),
            estimate.lights,
            estimate.reflectance,
            estimate.view_direction,
            caster,
            estimate.shadow_offset_mm,
            estimate.environment,
        ).light_linear.reshape(-1, 3)
        self._log_shading = np.log(np.maximum(shading, DARKEST * brightness))
        on_skin = image.seen * 1.0 if image.skin is None else image.skin
        self._skin = inside * bilinear(filled_from_nearest(on_skin[..., None], image.mask), pixels)[:, 0]
        covered = np.zeros(len(self._vertices), bool)
        if fitted.covered_faces is not None and len(fitted.covered_faces) == len(scan.faces):
            covered[scan.faces[fitted.covered_faces]] = True
        # Shares of hair, and of all that is not skin. What was left out of the fit is neither skin nor of the
        # same material as any neighbour.
        self._hair, other = self._materials(image, normals)
        apart = covered[nearest]
        self._other = np.where(apart, 1.0, other)
        # Links of the membrane, between points of one material.
        self._edges = edges_with_faces(self._faces)[0]
        i, j = self._edges.T
        same_material = (1 - self._other[i]) * (1 - self._other[j]) + self._other[i] * self._other[j]
        self._links = same_material * ~(apart[i] | apart[j])

    def _mean_log_color(self, scan: RawScan) -> FloatArray:
        """Return (N, 3) the log of the scan's mean colour nearest to each point."""
        # Colours are those of points inside of faces: beside the texture's charts is no colour.
        some = np.repeat(np.arange(0, len(scan.faces), 1 + len(scan.faces) // _COLORED_FACES), 3)
        corners = np.tile(np.eye(3) / 2 + 1 / 6, (len(some) // 3, 1))
        color, shown = scan_colors(scan, some, corners)
        shown |= not shown.any()
        places = np.einsum("nk,nkc->nc", corners, self._vertices[scan.faces[some]])
        total = np.zeros((len(self._points), 4))
        at = cKDTree(self._points).query(places[shown])[1]
        np.add.at(total, at, np.insert(color[shown], 3, 1, axis=1))
        mean = total[:, :3] / np.maximum(total[:, 3:], 1)
        color = filled_over_mesh(mean, total[:, 3] > 0, self._faces)
        return np.log(np.maximum(color, FLOOR * max(np.percentile(color, 95), FLOOR)))

    def _materials(self, image: GeometryImage, normals: FloatArray) -> FloatArray:
        """Return the shares (2, N) of hair, and of hair and cloth, by the face's own skin and hair."""
        few = np.zeros(image.shape, bool)
        few[:: -(-image.shape[0] // 128), :: -(-image.shape[1] // 128)] = True
        few &= image.mask if image.on_face is None else image.mask & image.on_face
        if image.face_chart is None or not few.any():
            return np.zeros((2, len(self._points)))
        closest = cKDTree(image.position[few]).query(self._points)[1]
        shares = materials_beyond_chart(
            self._log_color - self._log_shading,
            normals,
            self._skin,
            image.face_chart[few][closest],
            self._points - image.position[few][closest],
            self._mean,
            self._edge_mm,
        )
        return np.array([shares[-2], shares[-2:].sum(0)])

    def found(self, reach: str) -> LightBeyond:
        """Return the light of the scan's vertices (V,) where it is taken off the "face", or "all" of it."""
        count, other = len(self._points), self._other
        skin = np.zeros((count, 3))
        steepness = np.zeros(count)
        detail = 1.0
        if reach == "face":
            base = np.full((count, 3), math.log(self._brightness))
            offset, sure = self._membrane(base, self._per_edge(_FAR_MM), np.zeros((count, 4)))
            seen = sure > 2 / 255  # the least that a picture of the confidence shows
            offset, sure = offset * seen[:, None], sure * seen
        else:
            # Hair's and cloth's light is even.
            smooth = self._log_shading
            for _ in range(round(min(2 * (_EVEN_MM / self._edge_mm) ** 2, count))):
                smooth = self._mean @ smooth
            base = self._log_shading + other[:, None] * (smooth - self._log_shading)
            skin, wrong = self._skin_albedo(base)
            trust, detail = self._trust(wrong)
            far = self._per_edge(_FAR_MM)
            toward = np.hstack([wrong * (trust / (far + trust))[:, None], np.zeros((count, 1))])
            offset = self._membrane(base, far + trust, toward)[0]
            sure = np.ones(count)
            step = np.abs(np.diff((base + offset)[self._edges], axis=1)).max((1, 2))
            for ends in self._edges.T:
                np.maximum.at(steepness, ends, step)
            steepness *= 1 - other
        weight = self._hair_by_brightness()
        hair = np.clip(self._hair, FLOOR**2, 1 - FLOOR**2)
        log_odds = logit(hair) - weight * self._log_color.max(-1)
        found = LightBeyond(
            base + offset, OUTSIDE_CONFIDENCE * sure, skin, steepness, log_odds, weight, detail
        )
        nearby = surface_query(self._points, self._faces).query(self._vertices)
        return found.interpolated(lambda values: nearby.interpolated(values, self._faces))

    def _hair_by_brightness(self) -> float:
        """Return the weight of log brightness between hair and skin, of the means of both (Fisher's)."""
        if self._hair.max() <= SURE_HAIR:
            return 0.0
        own = self._log_color.max(-1) - self._log_shading.max(-1)
        parts = self._hair, np.maximum(1 - self._other, FLOOR)
        of_hair, of_skin = (np.average(own, weights=part) for part in parts)
        return (of_hair - of_skin) / (sum(np.cov(own, aweights=part) for part in parts) + _OWN**2)

    def _per_edge(self, over_mm: float) -> FloatArray:
        """Return (N,) the pull with which a membrane fades over so many mm."""
        # On a mesh of even triangles the sum over six edges is 3/2 edge^2 times the Laplacian.
        return np.full(len(self._points), 1.5 * (self._edge_mm / over_mm) ** 2)

    def _continued(self, values: FloatArray, pull: FloatArray, toward: FloatArray) -> FloatArray:
        """Return `values` (N, C) on the face, and beyond it what goes on from there."""
        beyond = ~self._on_face
        field = Field(self._edges, beyond, weight=self._links, pull=pull)
        return field.solve(np.where(beyond[:, None], toward, values))

    def _membrane(
        self, base: FloatArray, pull: FloatArray, toward: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the offset (N, 3) of the light from its `base`, and a 1 (N,) that fades alike."""
        ones = np.ones((len(base), 1))
        found = self._continued(np.hstack([self._chart - base, ones]), pull, toward)
        return found[:, :3], found[:, 3]

    def _skin_albedo(self, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return skin's expected log albedo (N, 3), and what colours differ by from it under `base`."""
        other = self._other[:, None]
        mean_skin = np.average(self._log_color - self._chart, axis=0, weights=self._skin + FLOOR)
        left = self._log_color - base - mean_skin
        # Skin's albedo goes on from the rim, then is half of what is left.
        own = self._continued(
            self._log_color - self._chart - mean_skin,
            self._per_edge(_EVEN_MM),
            (1 - other) * left / (2 + (left / _OWN) ** 2),
        )
        wrong = (1 - other) * (left - own)
        wrong += other * np.maximum(left.mean(-1, keepdims=True) - _WHITE, 0)
        return mean_skin + own, wrong

    def _trust(self, wrong: FloatArray) -> tuple[FloatArray, float]:
        """Return the pull (N,) toward what is `wrong` with the light, and the usual detail of skin."""
        other, around = self._other, wrong
        for _ in range(8):
            around = self._mean @ around
        # What stands out from around by more than detail does is a misplaced outline of light.
        fine = np.abs(wrong - around).max(-1)
        sure = ~self._on_face & (other < SURE_HAIR)
        detail = max(float(np.median(fine[sure])) if sure.any() else 1.0, FLOOR)
        outline = (1 - other) * (1 - self._mean @ other) * (1 + (fine / detail) ** 2)
        return self._per_edge(_EVEN_MM) * (other + outline), detail
