"""The geometry image of a fitted face: the model's chart rasterised, the scan's texture looked up."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import logsumexp

from scan2albedo.core import PlanStep
from scan2albedo.core.arguments import described, require_type
from scan2albedo.core.geometry_image import GeometryImage, check_size
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import GeometryImageError
from scan2albedo.face_model.appearance import appearance
from scan2albedo.geometry.mesh import face_areas, normalized, vertex_normals
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_directions, transform_points
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear
from scan2albedo.sampling.texture_lookup import texel_steps, texture_on_chart

if TYPE_CHECKING:
    from scan2albedo.face_model import AnnotatedSurface

SOFTENING = 1 / 50
"""Standard deviation of the blur of annotated values, as a fraction of the image's size."""

_CHART_TOLERANCE = 1e-6
WRONG = 0.05
"""Part of the scans whose texture does not belong to them as it is: turned by an exporter, or another's."""
_CHECK_SIZE = 128


class Fitted(Protocol):
    """The parts of a fitted face that sampling needs (`scan2albedo.fitting.FittedFace`)."""

    @property
    def vertices(self) -> NDArray[np.float64]:
        """(V, 3) mm, model frame."""

    @property
    def faces(self) -> NDArray[np.int64]:
        """(F, 3)."""

    @property
    def uv(self) -> NDArray[np.float64]:
        """(V, 2) chart coordinates."""

    @property
    def residual_mm(self) -> NDArray[np.float64]:
        """(V,) distance to the scan; NaN where there is none near."""

    @property
    def region(self) -> NDArray[np.uint8]:
        """(F,) region index."""

    @property
    def levels(self) -> int:
        """Refinements of the model's control mesh that give `faces`."""

    @property
    def model_from_scan(self) -> NDArray[np.float64]:
        """(4, 4)."""

    @property
    def model(self) -> AnnotatedSurface:
        """The model that was fitted."""


def geometry_image(fitted: Fitted, scan: RawScan | None, size: int = 512) -> GeometryImage:
    """Sample a fitted face on a regular grid over its chart [1]_.

    Position and normal come from the fitted limit surface, the texture from the closest point of the raw
    scan, low-pass filtered over each texel's footprint; `skin` and `labels` from the chart, the texture and
    the fit's residual. O(size^2 log F) for F scan faces.

    Parameters
    ----------
    fitted : FittedFace
        Vertices and chart in the model's frame, mm.
    scan : RawScan or None
        The raw scan in its own frame; None gives geometry without texture.
    size : int
        Height and width in texels, at least 8.

    Returns
    -------
    GeometryImage
        In the model's frame; `texture_linear` and `texture_valid` are None when the scan has no colour.

    Raises
    ------
    GeometryImageError
        When `size` is below 8, the fitted face holds NaN, or its chart covers no texel or leaves the unit
        square.
    TypeError
        For other objects than a fitted face and a scan.

    .. [1] X. Gu, S. Gortler, H. Hoppe, "Geometry Images", SIGGRAPH 2002.
    """
    if not (hasattr(fitted, "vertices") and hasattr(fitted, "model_from_scan")):
        raise TypeError(
            f"geometry_image: fitted is {described(fitted)}, expected a FittedFace; fit(scan, model, pose) "
            "returns one"
        )
    require_type(scan, (RawScan, type(None)), "geometry_image: scan", "load_scan(path) returns one")
    check_size(size)
    for name, values in (("vertices", fitted.vertices), ("uv", fitted.uv)):
        bad = int((~np.isfinite(values)).any(1).sum())
        if bad:
            raise GeometryImageError(
                f"the fitted face has {bad} vertices whose {name} are NaN or infinite; fit the scan again, "
                "and check the model"
            )
    outside = int((np.abs(fitted.uv - 0.5) > 0.5 + _CHART_TOLERANCE).any(1).sum())
    if outside:
        raise GeometryImageError(
            f"the model's chart leaves the unit square at {outside} of {len(fitted.uv)} vertices, which "
            "would be cut off; scale its uv into [0, 1]"
        )
    scan = None if scan is None else without_covers(fitted, scan)
    raster = rasterize_uv(fitted.uv, fitted.faces, size)
    if not raster.covered.any():
        raise GeometryImageError("the model's chart covers no texel; its uv must lie in the unit square")
    position = interpolate(raster, fitted.faces, fitted.vertices)
    normal = normalized(interpolate(raster, fitted.faces, vertex_normals(fitted.vertices, fitted.faces)))
    inside, scan_from_model = raster.covered, invert_rigid(fitted.model_from_scan)
    steps = texel_steps(fitted.vertices, fitted.uv, fitted.faces, raster.face.shape)[raster.face[inside]]
    texture = texture_on_chart(
        scan,
        inside,
        transform_points(scan_from_model, position[inside]),
        transform_directions(scan_from_model, normal[inside]),
        np.einsum("ij,njk->nik", scan_from_model[:3, :3], steps),
    )
    cameras = texture.camera_positions
    region = np.full(raster.face.shape, 255, np.uint8)
    region[inside] = fitted.region[raster.face[inside]]
    # Shininess changes gradually over skin; the annotation's steps would appear as outlines in the albedo.
    sigma, shiny = SOFTENING * size, _annotation(fitted, region, "specular_scale")
    weight, blurred = (
        gaussian_filter(field, sigma, mode="mirror", radius=math.ceil(4 * sigma))
        for field in (inside.astype(np.float32), np.where(inside, shiny, np.float32(0)))
    )
    face_chart, face_uv, counted = None, fitted.model.face_uv, fitted.model.face_regions()
    if face_uv is not None:
        refined = linear_refinement(len(face_uv), fitted.model.control_faces, fitted.levels) @ face_uv
        place = interpolate(raster, fitted.faces, np.column_stack([1 - refined[:, 1], refined[:, 0]]))
        face_chart = place.astype(np.float32)
    looks = appearance(
        position,
        normal,
        raster.covered if texture.seen is None else texture.seen,
        texture.linear,
        place=face_chart,
        share=_annotation(fitted, region, "skin_share"),
        residual_mm=interpolate(raster, fitted.faces, fitted.residual_mm),
    )
    # Embree would ignore collapsed triangles anyway.
    solid = fitted.faces[face_areas(fitted.vertices, fitted.faces) > 0]
    return GeometryImage(
        position=position,
        normal=normal,
        mask=raster.covered,
        texture_linear=texture.linear,
        region=region,
        occluder=(fitted.vertices, solid),
        texture_valid=texture.seen,
        filled=texture.filled,
        specular_scale=np.where(inside, blurred / np.maximum(weight, 1e-6), np.float32(0)),
        inpaint=_annotation(fitted, region, "inpaint") > 0,
        skin=looks.skin,
        labels=looks.labels,
        texture_log_odds=looks.log_odds,
        camera=texture.camera,
        camera_positions=None if cameras is None else transform_points(fitted.model_from_scan, cameras),
        face_chart=face_chart,
        on_face=None if counted.all() else counted[region] & inside,
    )


def without_covers(fitted: Fitted, scan: RawScan) -> RawScan:
    """Return the scan without the faces that the fit left out, whose colours are not the face's."""
    covered = getattr(fitted, "covered_faces", None)
    if covered is None or len(covered) != len(scan.faces):
        return scan
    return scan.without_faces(covered)


def _annotation(fitted: Fitted, region: NDArray[np.uint8], attribute: str) -> NDArray[np.float32]:
    return fitted.model.region_values(attribute)[region].astype(np.float32)


def texture_doubt(fitted: Fitted, scan: RawScan, image: GeometryImage) -> PlanStep | None:
    """Return the doubt that a scan's texture belongs to its shape, None where it most probably does.

    `image` is the scan's. Only where its odds are in doubt is the texture tried flipped, turned, with red and
    blue exchanged and as a negative, which takes some .2 s each.
    """
    log_odds = image.texture_log_odds + np.log((1 - WRONG) / WRONG)
    if scan.texture_linear is None or image.texture_log_odds > -np.log(WRONG):
        return None
    # One at a time: textures are large.
    tried = {
        name: geometry_image(fitted, other, _CHECK_SIZE).texture_log_odds for name, other in _variants(scan)
    }
    odds = list(tried.values())
    best = int(np.argmax(odds))
    # Against it stand all others, as they are, and the texture of something else (odds of 1).
    each = np.array(odds) - np.log(len(odds))
    rivals = [*np.delete(each, best), log_odds, 0.0]
    if each[best] > logsumexp(rivals):
        reason = f"the texture fits the shape {list(tried)[best]}: correct the export, or its coordinates"
        evidence = f"log odds {odds[best]:.1f}, as it is {image.texture_log_odds:.1f}"
        return PlanStep.doubt("texture", reason, evidence)
    if log_odds < 0:
        reason = (
            "brows, eyes and lips of the texture are not where the shape has them: is it another scan's, or "
            "shifted?"
        )
        return PlanStep.doubt("texture", reason, f"log odds {image.texture_log_odds:.1f}")
    return None


def _variants(scan: RawScan) -> Iterator[tuple[str, RawScan]]:
    """Yield what was done to the texture, and the scan with it so."""
    texture, shown = scan.texture_linear, scan.color_seen
    assert texture is not None
    back, same = slice(None, None, -1), slice(None)
    for name, way in (
        ("with V flipped", (back, same, same)),
        ("with U flipped", (same, back, same)),
        ("turned by 180 degrees", (back, back, same)),
        ("with red and blue exchanged", (same, same, back)),
    ):
        seen = None if shown is None else np.ascontiguousarray(shown[way[:2]])
        yield name, replace(scan, texture_linear=np.ascontiguousarray(texture[way]), color_seen=seen)
    negative = srgb_to_linear(1 - linear_to_srgb(texture)).astype(np.float32)
    yield "as a negative of itself", replace(scan, texture_linear=negative)
