"""Colour of a raw scan at given surface points, whether each was well seen, and by which camera."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    GridShape,
    IntArray,
    Values,
    dots,
    norms,
    on_grid,
    triangle_sides,
)
from scan2albedo.core.compiled import compiled
from scan2albedo.core.geometry_image import NO_CAMERA
from scan2albedo.geometry import mesh
from scan2albedo.geometry.closest_points import ClosestHits, surface_query
from scan2albedo.geometry.pinhole import camera_centers, fit_camera
from scan2albedo.geometry.rasterization import filled_smoothly
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.geometry.tangents import split_at_seams
from scan2albedo.io.texture_atlas import in_first_period

MAX_DISTANCE_MM = 4.0
"""Farther from the raw surface than this, a texel has no texture (hole, hair, ear)."""
MIN_DENSITY = 0.1
"""Photograph pixels per mm^2 relative to the scan's median: below, the view was grazing."""
CROP_MARGIN = 0.1
"""Faces are searched in the queried points' box, enlarged by this part of its size."""
FEWEST_TAPS = 3
"""Bilinear samples along each side of a texel's footprint, at least."""
MOST_TAPS = 64
"""Bilinear samples along each side of a texel's footprint, at most."""
MOVES = {
    "as it is": (1, 1, 0.0, 0.0),
    "with V flipped": (1, -1, 0.0, 1.0),
    "with U flipped": (-1, 1, 1.0, 0.0),
    "turned by 180 degrees": (-1, -1, 1.0, 1.0),
    "with U shifted by +3 %": (1, 1, -0.03, 0.0),
    "with U shifted by -3 %": (1, 1, 0.03, 0.0),
    "with V shifted by +3 %": (1, 1, 0.0, 0.03),
    "with V shifted by -3 %": (1, 1, 0.0, -0.03),
}
"""Where a pixel's colour is if the texture was moved: signs of its column and row, and parts of the texture's
width and height that are added."""
_LEAST_PART = 0.02
"""Part of all faces that a piece of the texture has from which a camera is fitted."""
_LEAST_FACES = 100
"""Faces that a piece of the texture has from which a camera is fitted."""
_OFF = 0.003
"""Median distance, as a part of a piece's span in the texture, by which a camera may miss it. Photographs of
a stereo scanner have 0.0005, unwrapped surfaces 0.01 and more."""
_RELIEF = 0.02
"""Least thickness of a piece as a part of its length: nothing shows where the camera of a plane stood."""
_FACING = 0.9
"""Part of a piece's faces that has to face its camera."""
_CAMERAS = 0.8
"""Part of the faces that cameras have to explain: the texture is photographs or it is not."""


def texture_on_chart(
    scan: RawScan | None,
    inside: BoolArray,
    points: FloatArray,
    normals: FloatArray,
    steps: FloatArray,
    image_from_scan: FloatArray,
) -> Values:
    """Return the fields of a `GeometryImage` that hold a scan's texture; none for scans without colour.

    At the texels `inside` (H, W) it is that of `sample_colors`; the image's frame is `image_from_scan` (4, 4)
    of the scan's. Where no picture showed the scan, the colour goes on from around.
    """
    if scan is None or not scan.has_color:
        return {}
    found = sample_colors(scan, points, normals, steps)
    linear, seen = on_grid(inside, found.color_linear), on_grid(inside, found.seen)
    texture: Values = {"texture_linear": linear, "texture_valid": seen}
    if not found.pictured.all():
        if not found.seen.any():
            return {}
        filled = on_grid(inside, ~found.pictured)
        linear[filled] = filled_smoothly(linear, seen)[filled]
        texture["filled"] = filled
    if (cameras := texture_cameras(scan)) is not None:
        number = cameras[0][found.face]
        camera = on_grid(inside, np.where(number < 0, NO_CAMERA, number).astype(np.uint8), NO_CAMERA)
        texture |= {"camera": camera, "camera_positions": transform_points(image_from_scan, cameras[1])}
    return texture


@dataclass(frozen=True)
class Samples:
    """Linear colour (N, 3) of surface points, the scan's `face` (N,), and two judgements of it (N,).

    Whether it was well `seen`, and whether it was `pictured`, of which `RawScan.color_seen` knows. With a
    texture, `pixel` (N, 2) is where they lie in it.
    """

    color_linear: Float32Array
    seen: BoolArray
    face: IntArray
    pictured: BoolArray
    pixel: FloatArray | None = None


def sample_colors(
    scan: RawScan,
    points: FloatArray,
    normals: FloatArray,
    steps: FloatArray,
    *,
    reach_mm: float = MAX_DISTANCE_MM,
) -> Samples:
    """Return what a scan's texture, or its vertices' colours, show of the surface closest to points.

    `points` and unit `normals` are (N, 3), scan frame, mm. `steps` (N, 3, 2) are the displacements (mm)
    on the surface of one texel to the right and one down: the footprint for means of the photograph. Beyond
    `reach_mm` nothing is seen.
    """
    # The faces near the points, all when none is: indexing the whole scan would cost most.
    margin = CROP_MARGIN * float(np.ptp(points, axis=0).max()) + reach_mm
    low, high = points.min(0) - margin, points.max(0) + margin
    inside = np.all((scan.vertices >= low) & (scan.vertices <= high), axis=1)
    near = np.flatnonzero(inside[scan.faces].any(1))
    near = near if len(near) else np.arange(len(scan.faces))
    hits = surface_query(scan.vertices, scan.faces[near]).query(points)
    face = near[hits.face]
    valid = hits.distance <= reach_mm
    facing = mesh.face_normals(scan.vertices, scan.faces[near])[hits.face]
    # The raw surface must face the way the fitted one does, within 60 degrees.
    valid &= dots(normals, facing) >= 0.5
    on_edge = mesh.boundary_vertex_mask(len(scan.vertices), scan.faces[near])[scan.faces[face]]
    # In a hole the closest point is on the scan's edge, and the point 0.5 mm or more sideways of it.
    at_edge = (np.where(on_edge, 0.0, hits.barycentric).sum(1) < 1e-6) & (on_edge.sum(1) >= 1)
    offset = points - hits.points
    sideways = offset - dots(offset, normals)[:, None] * normals
    valid &= ~(at_edge & (norms(sideways) > 0.5))
    pixel = None
    if scan.uv is not None and scan.texture_linear is not None:
        color, inside, pictured, pixel = _photograph(scan, near, hits, steps)
        # Faces need enough photograph pixels for their area.
        e1, e2 = scan.uv[:, 1] - scan.uv[:, 0], scan.uv[:, 2] - scan.uv[:, 0]
        texture_area = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
        density = texture_area / np.maximum(mesh.face_areas(scan.vertices, scan.faces), 1e-12)
        used = density[texture_area > 0]
        valid &= (density > (MIN_DENSITY * np.median(used) if len(used) else np.inf))[face] & inside
    else:
        assert scan.vertex_color_linear is not None
        color = hits.interpolated(scan.vertex_color_linear, scan.faces[near]).astype(np.float32)
        seen = np.ones(len(scan.vertices), bool) if scan.color_seen is None else scan.color_seen
        pictured = np.asarray(seen[scan.faces[face]].all(1))
    return Samples(color, valid & pictured, face, pictured, pixel)


def _photograph(
    scan: RawScan, near: IntArray, hits: ClosestHits, steps: FloatArray
) -> tuple[Float32Array, BoolArray, BoolArray, FloatArray]:
    """Average bilinear samples over each texel's footprint in the photograph; hits among faces `near`.

    Also return whether its centre is in the photograph, which wraps around only by whole periods for a
    face, whether a picture showed most of it (the mean is over that part), and the centre.
    """
    assert scan.uv is not None
    assert scan.texture_linear is not None
    height, width = scan.texture_linear.shape[:2]
    to_pixels = np.array([width, -height])
    uv = in_first_period(scan.uv[near], scan.texture_linear.shape)[hits.face]
    center = np.einsum("nk,nkc->nc", hits.barycentric, uv) * to_pixels + [-0.5, height - 0.5]
    inside = ((center >= -1.5) & (center <= np.array([width, height]) + 0.5)).all(1)
    # Gradients (F, 2, 3) of u and v over each of the faces, per mm; zero on degenerate ones.
    faces, corners = scan.faces[near], scan.vertices[scan.faces[near]]
    cross = mesh.face_cross_products(scan.vertices, faces)
    squared = np.maximum(dots(cross, cross), 1e-24)
    gradient = np.zeros((len(faces), 2, 3))
    for k in range(3):
        hat = np.cross(cross, corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3]) / squared[:, None]
        gradient += scan.uv[near, k, :, None] * hat[:, None, :]
    footprint = np.einsum("nck,nkd->ncd", gradient[hits.face], steps) * to_pixels[:, None]
    # So many that no pixel between them is left out, in 95 of 100 texels.
    sides = np.linalg.norm(footprint, axis=1).max(1)
    longest = float(np.percentile(sides, 95)) if len(sides) else 0.0
    taps = int(np.clip(np.ceil(longest), FEWEST_TAPS, MOST_TAPS))
    if scan.color_seen is None:
        color = mean_over_footprints(scan.texture_linear, center, footprint, taps)
        return color, inside, np.ones(len(color), bool), center
    shown = scan.color_seen[..., None].astype(np.float32)
    weighted = np.concatenate([scan.texture_linear * shown, shown], axis=2)
    total = mean_over_footprints(weighted, center, footprint, taps)
    color = total[:, :3] / np.maximum(total[:, 3:], np.finfo(np.float32).tiny)
    return color, inside, total[:, 3] > 0.5, center


def texture_cameras(scan: RawScan) -> tuple[IntArray, FloatArray] | None:
    """Find the cameras whose photographs a scan's texture is made of; None where it is not.

    Returns the number (F,) of the camera that took each face, -1 where it is not known, and where the cameras
    stood (K, 3), mm in the scan's frame.
    Of a photograph, texture coordinates are the vertices' projection by a pinhole camera. It is fitted to
    each connected piece of the texture, large ones first; unwrapped surfaces fit none.
    """
    if scan.uv is None or scan.texture_linear is None or len(scan.faces) < _LEAST_FACES:
        return None
    height, width = scan.texture_linear.shape[:2]
    corners, pixels = scan.vertices[scan.faces], scan.uv * np.array([width, height])
    normals = mesh.face_normals(scan.vertices, scan.faces)
    # The connected piece of the texture that each face is part of.
    corner = split_at_seams(scan.faces, scan.uv).faces
    pieces = mesh.vertex_components(int(corner.max()) + 1, corner)[corner[:, 0]]
    camera, positions = np.full(len(scan.faces), -1), list[FloatArray]()
    sizes = np.bincount(pieces)
    least = max(_LEAST_FACES, _LEAST_PART * len(scan.faces))
    for piece in np.flatnonzero(sizes >= least)[np.argsort(-sizes[sizes >= least], kind="stable")]:
        inside = pieces == piece
        if np.mean(camera[inside] >= 0) > 0.5 or len(positions) == 100:
            continue
        tolerance = _OFF * float(np.ptp(pixels[inside].reshape(-1, 2), axis=0).max())
        every = np.flatnonzero(inside)
        some = every[np.linspace(0, len(every) - 1, min(len(every), 4000)).astype(int)]
        points, places = corners[some].reshape(-1, 3), pixels[some].reshape(-1, 2)
        extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if extents[2] < _RELIEF * extents[0]:
            continue
        kept: BoolArray = np.ones(len(points), bool)
        for _ in range(4):
            fitted = fit_camera(points[kept], places[kept])
            off = _distances(fitted, points, places)
            kept = off <= 4 * np.median(off)
        if not np.median(off) < tolerance:
            continue
        position = camera_centers(fitted[None])[0]
        facing = dots(position - corners[inside, 0], normals[inside]) > 0
        if facing.mean() < _FACING:
            continue
        off = _distances(fitted, corners, pixels).max(1)
        camera[(camera < 0) & (inside | (off < tolerance))] = len(positions)
        positions.append(position)
    if np.mean(camera >= 0) < _CAMERAS:
        return None
    return camera, np.array(positions)


def _distances(camera: FloatArray, points: FloatArray, places: FloatArray) -> FloatArray:
    """Return how far from `places` (..., 2) a camera (3, 4) projects points (..., 3)."""
    image = points @ camera[:, :3].T + camera[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return norms(image[..., :2] / image[..., 2:] - places)


def texel_steps(vertices: FloatArray, uv: FloatArray, faces: IntArray, shape: GridShape) -> FloatArray:
    """Return (F, 3, 2): displacement in mm of one texel to the right and one texel down on each face."""
    corners, chart = vertices[faces], uv[faces]
    edges = np.stack(triangle_sides(corners), 2)
    chart_edges = np.stack(triangle_sides(chart), 2)
    usable = np.abs(np.linalg.det(chart_edges)) > 1e-15
    inverse = np.zeros_like(chart_edges)
    inverse[usable] = np.linalg.inv(chart_edges[usable])
    height, width = shape
    return edges @ inverse @ np.array([[1 / width, 0.0], [0.0, -1 / height]])


def moved_colors(
    scan: RawScan, seen: BoolArray, points: FloatArray, normals: FloatArray
) -> dict[str, Float32Array]:
    """Return the colours (H, W, 3) at the texels `seen` (H, W), by what may have been done to the texture.

    Of those texels are `points` and `normals` (N, 3), mm in the scan's frame.
    """
    pixel = sample_colors(scan, points, normals, np.zeros((len(points), 3, 2))).pixel
    assert pixel is not None
    assert scan.texture_linear is not None
    last = np.array(scan.texture_linear.shape[1::-1]) - 1
    # Means over squares of about a texel.
    step = float(np.median(norms(np.diff(pixel, axis=0))))
    square = np.tile(step * np.eye(2), (len(pixel), 1, 1))
    found = {}
    for name, (sign_u, sign_v, u, v) in MOVES.items():
        there = pixel * (sign_u, sign_v) + last * (u, v)
        means = mean_over_footprints(scan.texture_linear, there, square, FEWEST_TAPS)
        found[name] = on_grid(seen, means)
    return found


@compiled
def mean_over_footprints(photograph, centre, footprint, taps):  # type: ignore[no-untyped-def]
    """Return (N, C) float32 means of samples of a photograph (H, W, C) over each texel's footprint.

    `centre` (N, 2) is the middle of each footprint in pixels, (0, 0) the middle of the first pixel;
    `footprint` (N, 2, 2) has its two sides, as columns, with `taps` bilinear samples along each.
    """
    height, width, channels = photograph.shape
    mean = np.empty((len(centre), channels), np.float32)
    total = np.empty(channels)
    for n in range(len(centre)):
        total[:] = 0.0
        for i in range(taps):
            right = (i + 0.5) / taps - 0.5
            for j in range(taps):
                down = (j + 0.5) / taps - 0.5
                x = centre[n, 0] + right * footprint[n, 0, 0] + down * footprint[n, 0, 1]
                y = centre[n, 1] + right * footprint[n, 1, 0] + down * footprint[n, 1, 1]
                # Written so that NaN, too, ends inside.
                x = min(x, width - 1.0) if x > 0 else 0.0
                y = min(y, height - 1.0) if y > 0 else 0.0
                left, top = int(x), int(y)
                u, v = x - left, y - top
                next_column, below = min(left + 1, width - 1), min(top + 1, height - 1)
                for c in range(channels):
                    upper = (1 - u) * photograph[top, left, c] + u * photograph[top, next_column, c]
                    lower = (1 - u) * photograph[below, left, c] + u * photograph[below, next_column, c]
                    total[c] += (1 - v) * upper + v * lower
        for c in range(channels):
            mean[n, c] = total[c] / (taps * taps)
    return mean
