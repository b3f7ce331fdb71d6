"""Geometry images of any scanned object, without a face model: xatlas charts."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arguments import require_type
from scan2albedo.core.geometry_image import GeometryImage, check_size
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import GeometryImageError
from scan2albedo.geometry.mesh import face_areas, normalized, turned_against_neighbours, vertex_normals
from scan2albedo.geometry.parametrization import LAST_ATLAS
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.geometry.rigid import compose
from scan2albedo.sampling.texture_lookup import texel_steps, texture_on_chart

MOST_FACES = 15_000
"""Larger surfaces are simplified to this for charting: xatlas's time grows faster than linearly."""


def geometry_image_of_scan(scan: RawScan, size: int = 512) -> GeometryImage:
    """Sample any scanned surface on a grid over charts that xatlas cuts and packs.

    Raises GeometryImageError when `size` is below 8, or no chart can be made (only zero-area faces).

    Parameters
    ----------
    scan : RawScan
        Any object; its own frame, mm.
    size : int
        Height and width in texels, at least 8.

    Returns
    -------
    GeometryImage
        In the scan's frame with its centroid moved to the origin; no regions.
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
        fewer, index, _, _ = igl.qslim(vertices[source], np.asarray(split, np.int64), MOST_FACES, False)
        if len(index) == 0:
            raise GeometryImageError(
                f"{scan.name}: its {len(split)} faces cannot be simplified to the {MOST_FACES} that charts "
                "are cut from; give a mesh of fewer faces"
            )
        vertices, faces = np.asarray(fewer, np.float64), np.asarray(index, np.int64)
    # xatlas computes in float32 with absolute tolerances: it gets the mesh at the origin, of a head's size.
    used = vertices[np.unique(faces)]
    low, high = used.min(0), used.max(0)
    placed = (vertices - (low + high) / 2) * (200 / float(np.max(high - low)))
    LAST_ATLAS[:] = [atlas := xatlas.Atlas()]
    atlas.add_mesh(placed.astype(np.float32), faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.resolution, pack.padding, pack.create_image = size, 2, False
    atlas.generate(xatlas.ChartOptions(), pack)
    chart_vertex, chart_faces, uv = atlas[0]
    chart_vertex, chart_faces = chart_vertex.astype(np.int64), chart_faces.astype(np.int64)
    # xatlas may need more than the resolution asked for; scale all charts into one square.
    extent = np.array([atlas.width, atlas.height], float) / max(atlas.width, atlas.height, 1)
    uv = np.asarray(uv, float) * extent
    position_of, normal_of = vertices[chart_vertex], vertex_normals(vertices, faces)[chart_vertex]
    raster = rasterize_uv(uv, chart_faces, size)
    if not raster.covered.any():
        raise GeometryImageError(
            f"{scan.name}: xatlas made no chart that covers a texel at size {size}; choose a larger size, "
            "and remove vertices that lie far from the rest, which shrink it"
        )
    inside = raster.covered
    position = interpolate(raster, chart_faces, position_of)
    normal = normalized(interpolate(raster, chart_faces, normal_of))
    steps = texel_steps(position_of, uv, chart_faces, raster.face.shape)[raster.face[inside]]
    center = vertices.mean(0)
    centered = compose(np.eye(3), -center)
    texture = texture_on_chart(scan, inside, position[inside], normal[inside], steps, centered)
    position[inside] -= center
    return GeometryImage(position, normal, inside, occluder=(vertices - center, faces), **texture)
