"""Geometry images: of a fitted face on its model's chart, and of any scanned object on charts of xatlas."""

import math

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import logsumexp

from scan2albedo.core import GeometryImage, PlanStep, RawScan
from scan2albedo.core.arguments import described, require_type
from scan2albedo.core.arrays import ByteArray, Float32Array, on_grid
from scan2albedo.core.geometry_image import check_size
from scan2albedo.errors import GeometryImageError
from scan2albedo.face_model.annotation import FittedSurface
from scan2albedo.face_model.materials import chart_materials, fit_to_places
from scan2albedo.geometry.mesh import face_areas, normalized, turned_against_neighbours, vertex_normals
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.geometry.rigid import compose, invert_rigid, transform_directions, transform_points
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear
from scan2albedo.sampling.texture_lookup import MOVES, moved_colors, texel_steps, texture_on_chart

WRONG = 0.05
"""Part of the scans whose texture does not belong to them as it is: turned by an exporter, or another's."""
_CHECK_SIZE = 48
"""Side of the grid on which the texture is held against the shape."""
MOST_FACES = 15_000
"""Larger surfaces are simplified to this for charting: xatlas's time grows faster than linearly."""
LAST_ATLAS: list[object] = []
"""Kept until the next one: an atlas that ends too soon can wait forever for a thread that goes to sleep."""


def geometry_image(fitted: FittedSurface, scan: RawScan | None, size: int = 512) -> GeometryImage:
    """Sample a fitted face on a regular grid over its chart [1]_.

    Position and normal come from the fitted limit surface, the texture from the closest point of the raw
    scan, low-pass filtered over each texel's footprint; `skin` and `labels` from the chart, the texture and
    the fit's residual. O(size^2 log F) for F scan faces. Raises GeometryImageError when `size` is below 8,
    the fitted face holds NaN, or its chart covers no texel or leaves the unit square; TypeError for other
    objects than a fitted face and a scan.

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

    .. [1] X. Gu, S. Gortler, H. Hoppe, "Geometry Images", SIGGRAPH 2002.
    """
    if not (hasattr(fitted, "vertices") and hasattr(fitted, "model_from_scan")):
        said = f"geometry_image: fitted is {described(fitted)}, expected a FittedFace"
        raise TypeError(f"{said}; fit(scan, model, pose) returns one")
    require_type(scan, (RawScan, type(None)), "geometry_image: scan", "load_scan(path) returns one")
    check_size(size)
    for name, values in (("vertices", fitted.vertices), ("uv", fitted.uv)):
        bad = int((~np.isfinite(values)).any(1).sum())
        if bad:
            said = f"the fitted face has {bad} vertices whose {name} are NaN or infinite"
            raise GeometryImageError(f"{said}; fit the scan again, and check the model")
    outside = int((np.abs(fitted.uv - 0.5) > 0.5 + np.finfo(np.float32).resolution).any(1).sum())
    if outside:
        said = f"the model's chart leaves the unit square at {outside} of {len(fitted.uv)} vertices"
        raise GeometryImageError(f"{said}, which would be cut off; scale its uv into [0, 1]")
    scan = None if scan is None else without_covers(fitted, scan)
    raster = rasterize_uv(fitted.uv, fitted.faces, size)
    if not raster.covered.any():
        raise GeometryImageError("the model's chart covers no texel; its uv must lie in the unit square")
    position = interpolate(raster, fitted.faces, fitted.vertices)
    normal = normalized(interpolate(raster, fitted.faces, vertex_normals(fitted.vertices, fitted.faces)))
    inside, scan_from_model = raster.covered, invert_rigid(fitted.model_from_scan)
    steps = texel_steps(fitted.vertices, fitted.uv, fitted.faces, raster.face.shape)[raster.face[inside]]
    place = transform_points(scan_from_model, position[inside])
    facing = transform_directions(scan_from_model, normal[inside])
    steps = np.einsum("ij,njk->nik", scan_from_model[:3, :3], steps)
    texture = texture_on_chart(scan, inside, place, facing, steps, fitted.model_from_scan)
    region = on_grid(inside, fitted.region[raster.face[inside]], 255)
    # Shininess changes gradually over skin; the annotation's steps would appear as outlines in the albedo.
    sigma, shiny = size / 50, _annotation(fitted, region, "specular_scale")
    weight, blurred = (
        gaussian_filter(field, sigma, mode="mirror", radius=math.ceil(4 * sigma))
        for field in (inside.astype(np.float32), np.where(inside, shiny, np.float32(0)))
    )
    face_chart, face_uv, counted = None, fitted.model.face_uv, fitted.model.face_regions()
    if face_uv is not None:
        refined = linear_refinement(len(face_uv), fitted.model.control_faces, fitted.levels) @ face_uv
        place = interpolate(raster, fitted.faces, np.column_stack([1 - refined[:, 1], refined[:, 0]]))
        face_chart = place.astype(np.float32)
    looks = chart_materials(
        position,
        normal,
        texture.get("texture_valid", raster.covered),
        texture.get("texture_linear"),
        place=face_chart,
        share=_annotation(fitted, region, "skin_share"),
        residual_mm=interpolate(raster, fitted.faces, fitted.residual_mm),
    )
    # Embree would ignore collapsed triangles anyway.
    return GeometryImage(
        position=position,
        normal=normal,
        mask=raster.covered,
        region=region,
        occluder=(fitted.vertices, fitted.faces[face_areas(fitted.vertices, fitted.faces) > 0]),
        specular_scale=np.where(inside, blurred / np.maximum(weight, 1e-6), np.float32(0)),
        inpaint=_annotation(fitted, region, "inpaint") > 0,
        skin=looks.skin,
        labels=looks.labels,
        texture_log_odds=looks.log_odds,
        face_chart=face_chart,
        on_face=None if counted.all() else counted[region] & inside,
        **texture,
    )


def geometry_image_of_scan(scan: RawScan, size: int = 512) -> GeometryImage:
    """Return any scanned surface sampled on a grid over charts that xatlas cuts and packs.

    The image has `size` x `size` texels, 8 or more, and no regions; its frame is that of `scan`, mm, with the
    centroid moved to the origin. Raises GeometryImageError when `size` is below 8, or no chart can be made
    (only zero-area faces).
    """
    import igl
    import xatlas

    require_type(scan, RawScan, "geometry_image_of_scan: scan", "load_scan(path) returns one")
    check_size(size)
    # The scan welded, each face once, with area and wound alike, its edges collapsed down to `MOST_FACES`.
    vertices, inverse = np.unique(scan.vertices, axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[scan.faces]
    faces = faces[face_areas(vertices, faces) > 0]
    if len(faces) == 0:
        raise GeometryImageError(f"{scan.name}: every face has zero area; there is no surface to sample")
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(first)]
    faces = np.where(turned_against_neighbours(faces)[:, None], faces[:, ::-1], faces)
    if len(faces) > MOST_FACES:
        # qslim returns nothing where parts of a mesh meet in one vertex: such vertices are split first.
        split, source = igl.split_nonmanifold(faces)[:2]
        fewer, index, _, _ = igl.qslim(vertices[source], np.asarray(split, int), MOST_FACES, False)
        if len(index) == 0:
            raise GeometryImageError(
                f"{scan.name}: its {len(split)} faces cannot be simplified to the {MOST_FACES} that charts "
                "are cut from; give a mesh of fewer faces"
            )
        vertices, faces = np.asarray(fewer, float), np.asarray(index, int)
    # xatlas computes in float32 with absolute tolerances: it gets the mesh at the origin, of a head's size.
    used = vertices[np.unique(faces)]
    low, high = used.min(0), used.max(0)
    placed = (vertices - (low + high) / 2) * (200 / float(np.max(high - low)))
    LAST_ATLAS[:] = [atlas := xatlas.Atlas()]
    atlas.add_mesh(placed.astype(np.float32), faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.resolution = size
    pack.padding = 2
    pack.create_image = False
    atlas.generate(xatlas.ChartOptions(), pack)
    chart_vertex, chart_faces, uv = atlas[0]
    chart_vertex, chart_faces = chart_vertex.astype(int), chart_faces.astype(int)
    # xatlas may need more than the resolution asked for; scale all charts into one square.
    extent = np.array([atlas.width, atlas.height], float) / max(atlas.width, atlas.height, 1)
    uv = np.asarray(uv, float) * extent
    position_of, normal_of = vertices[chart_vertex], vertex_normals(vertices, faces)[chart_vertex]
    raster = rasterize_uv(uv, chart_faces, size)
    if not raster.covered.any():
        said = f"{scan.name}: xatlas made no chart that covers a texel at size {size}"
        advice = "choose a larger size, and remove vertices that lie far from the rest, which shrink it"
        raise GeometryImageError(f"{said}; {advice}")
    inside = raster.covered
    position = interpolate(raster, chart_faces, position_of)
    normal = normalized(interpolate(raster, chart_faces, normal_of))
    steps = texel_steps(position_of, uv, chart_faces, raster.face.shape)[raster.face[inside]]
    center = vertices.mean(0)
    centered = compose(np.eye(3), -center)
    texture = texture_on_chart(scan, inside, position[inside], normal[inside], steps, centered)
    position[inside] -= center
    return GeometryImage(position, normal, inside, occluder=(vertices - center, faces), **texture)


def without_covers(fitted: FittedSurface, scan: RawScan) -> RawScan:
    """Return the scan without the faces that the fit left out, whose colours are not the face's."""
    covered = getattr(fitted, "covered_faces", None)
    if covered is None or len(covered) != len(scan.faces):
        return scan
    return scan.without_faces(covered)


def _annotation(fitted: FittedSurface, region: ByteArray, attribute: str) -> Float32Array:
    return fitted.model.region_values(attribute)[region].astype(np.float32)


def texture_doubt(fitted: FittedSurface, scan: RawScan, image: GeometryImage) -> PlanStep | None:
    """Return the doubt that a scan's texture belongs to its shape, None where it most probably does.

    `image` is the scan's. The texture as it is stands against itself moved, with red and blue exchanged, as a
    negative, and against any other thing's. O(texels); 0.2 s.
    """
    every = max(1, len(image.mask) // _CHECK_SIZE)
    part = np.s_[every // 2 :: every, every // 2 :: every]
    seen, place = image.seen[part], image.face_chart
    if scan.texture_linear is None or place is None or np.count_nonzero(seen) < _CHECK_SIZE:
        return None
    position, normal = image.position[part], image.normal[part]
    scan_from_model = invert_rigid(fitted.model_from_scan)
    points = transform_points(scan_from_model, position[seen])
    normals = transform_directions(scan_from_model, normal[seen])
    colors = moved_colors(without_covers(fitted, scan), seen, points, normals)
    unchanged = colors["as it is"]
    colors["with red and blue exchanged"] = np.ascontiguousarray(unchanged[..., ::-1])
    colors["as a negative of itself"] = srgb_to_linear(1 - linear_to_srgb(unchanged)).astype(np.float32)
    fits = {
        name: fit_to_places(position, normal, seen, place[part], texture) for name, texture in colors.items()
    }
    own, even, evidence = fits.pop("as it is")
    own, prior = np.logaddexp(own, even), np.log(WRONG / (1 - WRONG))
    other = own - image.texture_log_odds + prior
    # Where a part of the texture shows no face, its own evidence says nothing of it.
    rivals = {
        name: odds + (name in MOVES) * (known - evidence) + prior - np.log(len(fits))
        for name, (odds, _, known) in fits.items()
        if odds > 0
    }
    said, *others = sorted(rivals, key=lambda name: -rivals[name]) or ["as it is"]
    log_odds = f"log odds {image.texture_log_odds:.1f}"
    if rivals and logsumexp(list(rivals.values())) > np.logaddexp(own, other):
        log_odds = f"log odds {rivals[said] - own:.1f} against it as it is"
        said = " or ".join([said, *(name for name in others[:1] if rivals[name] > rivals[said] + prior)])
        reason = f"the texture fits the shape {said}: correct the export, or its coordinates"
    elif own < other:
        reason = "brows, eyes and lips of the texture are not where the shape has them"
        reason += ": is it another scan's, or shifted?"
    else:
        return None
    return PlanStep.doubt("texture", reason, log_odds)
