"""An annotated surface out of anyone's dense template (`AnnotatedFaceModel.from_mesh`)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import ByteArray, FloatArray, IntArray, all_finite, finite_rows, norms, row_sums
from scan2albedo.errors import ModelError
from scan2albedo.face_model import AnnotatedSurface, Region
from scan2albedo.face_model.annotation import FILLED_REGION, LANDMARK_LEVELS, REST_REGION, surface_frames
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.fields import factorized
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints
from scan2albedo.geometry.mesh import adjacency, face_cross_products, vertex_normals, without_unreferenced
from scan2albedo.templates.surface import TemplateSurface, clean_template

LANDMARK_REACH_MM = 30.0
"""A landmark lies at most so far from the template."""
MAX_REGIONS = 253
"""Regions that a map of 8 bits holds, beside the rest, filled holes and no surface."""
MIN_CONTROL_SIZE = 20
"""Fewer control vertices hold no face."""
SMOOTHNESS = 0.005
"""Weight of the control mesh's Laplacian in `fit_limit_surface`."""
SAME_UV = 1e-6
"""Corners whose texture coordinates differ by less have one place."""
UV_SLACK = 1e-3
"""How far texture coordinates may leave the ten tiles."""


@dataclass(frozen=True)
class DenseTemplate:
    """The arguments of `AnnotatedFaceModel.from_mesh`; see there."""

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None
    """(T, 2), or (F, 3, 2) of the corners."""
    regions: Mapping[str, IntArray] | None
    landmarks: FloatArray | IntArray | None
    name: str


def model_from_surface(
    surface: TemplateSurface, template: DenseTemplate, control_size: int
) -> AnnotatedSurface:
    """Make a surface of about `control_size` control vertices from a template in the model's axes.

    Raises `ModelError` when the template, the regions or the landmarks cannot be used.
    """
    name = template.name
    if not control_size >= MIN_CONTROL_SIZE:
        raise ModelError(
            f"{name}: control_size is {control_size}, but fewer than {MIN_CONTROL_SIZE} control vertices "
            "hold no face; 1000 are usual"
        )
    disc, filled = clean_template(surface, name)
    # The template vertices that it uses, and its faces among them.
    source, clean_faces = without_unreferenced(disc.vertices, disc.faces)
    clean, faces = disc.vertices[source], np.array(template.faces, int)
    control, control_faces = fit_limit_surface(clean, clean_faces, control_size)
    subdivision = LoopSubdivision.of(len(control), control_faces, LANDMARK_LEVELS)
    # The cleaned vertices are placed on the limit surface, loose ones where the nearest of these is.
    inner = project(subdivision, control, clean, vertex_normals(clean, clean_faces))
    tree = cKDTree(clean)
    distance, nearest = tree.query(disc.vertices)
    face, barycentric = inner.face[nearest].copy(), inner.barycentric[nearest].copy()
    face[source], barycentric[source] = inner.face, inner.barycentric
    apart = distance > 1e-3
    apart[source] = False
    if apart.any():
        loose = project(subdivision, control, disc.vertices[apart], np.zeros((1, 3)))
        face[apart], barycentric[apart] = loose.face, loose.barycentric
    placed = SurfacePoints(face, barycentric)
    matrix, frames = subdivision.points_matrix(placed), surface_frames(control[control_faces[face]])
    offset = np.einsum("nij,ni->nj", frames, disc.vertices - matrix @ control)
    # Each control face gets the region of the template vertex nearest to its centre.
    label, table = _regions(template, faces)
    region = label[source][tree.query(control[control_faces].mean(1))[1]]
    if filled.any():
        index = len(table)
        corners = disc.vertices[disc.faces[filled]]
        region[project(subdivision, control, corners.mean(1), np.zeros((1, 3))).face] = index
        # These faces are softer, so that a mouth may open.
        table[FILLED_REGION] = Region(FILLED_REGION, index, 0.5, 0.0, False)
    chart, chart_note = _chart(vertex_uv(template), source, (control, control_faces), matrix, name)
    corners_uv, uv_note = corner_uv(template)
    off = norms(offset[source])
    away = f"the surface keeps {off.mean():.1f} mm (mean) and {off.max():.0f} mm (most) from the template"
    coarse = f"{away}; a greater control_size follows it better" if off.mean() > 1 else ""
    notes = (*disc.notes, coarse, chart_note, uv_note)
    return AnnotatedSurface(
        control_vertices=control,
        control_faces=control_faces,
        uv=chart,
        region=region,
        regions=table,
        landmark_points=_landmarks(template, disc, source, placed),
        template_points=placed,
        template_offset=offset,
        template_faces=faces,
        template_uv=corners_uv,
        template_from_model=surface.template_from_surface,
        notes=tuple(filter(None, notes)),
        name=name,
    )


def vertex_uv(template: DenseTemplate) -> FloatArray | None:
    """Return (T, 2) where all corners of a vertex agree, (0, 0) without a face; None at seams and gaps."""
    if template.uv is None or np.ndim(template.uv) != 3:
        return template.uv
    faces, corners = np.array(template.faces, int), np.asarray(template.uv, float)
    if corners.shape != (len(faces), 3, 2):
        raise ModelError(f"{template.name}: uv has shape {corners.shape}, expected ({len(faces)}, 3, 2)")
    uv = np.zeros((len(template.vertices), 2))
    uv[faces.ravel()] = corners.reshape(-1, 2)
    return uv if (np.abs(uv[faces] - corners) < SAME_UV).all() else None


def corner_uv(template: DenseTemplate) -> tuple[FloatArray | None, str]:
    """Return (F, 3, 2) the coordinates of the faces' corners, and a note where they can carry no texture."""
    if template.uv is None:
        return None, ""
    uv = np.asarray(template.uv, float)
    corners = uv if uv.ndim == 3 else uv[np.array(template.faces, int)]
    why = ""
    if not all_finite(corners):
        why = f"{(~np.isfinite(corners)).any((1, 2)).sum()} faces have no texture coordinates"
    elif (corners < -UV_SLACK).any() or (corners > 10 + UV_SLACK).any():
        why = "texture coordinates lie beyond the tiles of UDIM (u and v from 0 to 10)"
    elif not np.ptp(corners, axis=1).any():
        why = "all corners have the same texture coordinates"
    return (None, f"no texture will be painted: {why}") if why else (corners, "")


def _chart(
    uv: FloatArray | None,
    source: IntArray,
    mesh: tuple[FloatArray, IntArray],
    matrix: sparse.csr_matrix,
    name: str,
) -> tuple[FloatArray, str]:
    """Return (C, 2), the given chart solved for control vertices or a new one, and a note where it is new."""
    from scan2albedo.geometry.parametrization import parametrize_disc

    note = ""
    if uv is not None:
        values = np.asarray(uv, float)
        if values.shape != (matrix.shape[0], 2):
            said = f"{name}: uv has shape {values.shape}, expected ({matrix.shape[0]}, 2)"
            raise ModelError(f"{said}: one coordinate a vertex; split vertices at seams or leave uv out")
        known = values[source]
        note = "a new chart was drawn: the uv given holds NaN"
        if all_finite(known):
            rows = matrix[source]
            tie = 1e-6 * sparse.identity(rows.shape[1])
            chart = np.clip(factorized(rows.T @ rows + tie)(rows.T @ known), 0.0, 1.0)
            flat = np.column_stack([chart, np.zeros(len(chart))])
            if (face_cross_products(flat, mesh[1])[:, 2] > 0).all():
                return chart, ""
            note = "a new chart was drawn: the uv given folds over or leaves the unit square"
    return parametrize_disc(*mesh), note


def _regions(template: DenseTemplate, faces: IntArray) -> tuple[ByteArray, dict[str, Region]]:
    """Return the region (T,) of each template vertex, and the regions by name."""
    name, regions, count = template.name, dict(template.regions or {}), len(template.vertices)
    if taken := sorted({REST_REGION, FILLED_REGION} & set(regions)):
        raise ModelError(f"{name}: region {taken[0]!r} is taken: faces in none or over holes; rename it")
    if len(regions) > MAX_REGIONS:
        raise ModelError(f"{name}: {len(regions)} regions given, at most {MAX_REGIONS} fit the region map")
    label, table = np.zeros(count, np.uint8), {REST_REGION: Region(REST_REGION, 0)}
    for index, (title, values) in enumerate(regions.items(), start=1):
        members = np.asarray(values)
        is_index = members.dtype.kind in "iu" and members.ndim == 1
        if members.dtype == bool and members.shape == (count,):
            label[members] = index
        elif members.dtype == bool and members.shape == (len(faces),):
            label[faces[members]] = index
        elif is_index and ((members >= 0) & (members < count)).all():
            label[members] = index
        else:
            raise ModelError(
                f"{name}: region {title!r} has shape {members.shape} and type {members.dtype}; expected "
                f"vertex indices from 0 to {count - 1}, or a bool mask of {count} vertices or {len(faces)} "
                "faces"
            )
        table[title] = Region(title, index)
    return label, table


def _landmarks(
    template: DenseTemplate, disc: TemplateSurface, source: IntArray, placed: SurfacePoints
) -> SurfacePoints | None:
    if template.landmarks is None:
        return None
    name, landmarks = template.name, np.asarray(template.landmarks)
    vertices = np.asarray(template.vertices, float)
    if landmarks.shape == (68,) and landmarks.dtype.kind in "iu":
        if landmarks.min() < 0 or landmarks.max() >= len(vertices):
            wrong = landmarks.min() if landmarks.min() < 0 else landmarks.max()
            raise ModelError(f"{name}: landmark vertex {wrong} out of range 0 ... {len(vertices) - 1}")
        chosen = landmarks.astype(int)
    elif landmarks.shape == (68, 3):
        # Points in the template's own unit and frame: the nearest cleaned vertices.
        points, cleaned = landmarks.astype(float), vertices[source]
        if not all_finite(points):
            wrong = int(np.flatnonzero(~finite_rows(points))[0])
            raise ModelError(f"{name}: landmark {wrong} is NaN or infinite; give its point, or no landmarks")
        distance, nearest = cKDTree(cleaned).query(points)
        distance /= float(np.ptp(cleaned, axis=0).max() / np.ptp(disc.vertices[source], axis=0).max())
        farthest = int(np.argmax(distance))
        if distance[farthest] > LANDMARK_REACH_MM:
            raise ModelError(
                f"{name}: landmark {farthest} lies {distance[farthest]:.0f} mm from the template, at most "
                f"{LANDMARK_REACH_MM:.0f} expected; give landmarks in the template's own frame"
            )
        chosen = source[nearest]
    else:
        raise ModelError(f"{name}: landmarks are {landmarks.shape}, expected (68, 3) points or (68,) indices")
    return SurfacePoints(placed.face[chosen], placed.barycentric[chosen])


def fit_limit_surface(vertices: FloatArray, faces: IntArray, size: int) -> tuple[FloatArray, IntArray]:
    """Return about `size` control vertices and faces whose limit surface passes near a dense mesh (K, 3).

    The control mesh P_0 is the dense one with edges collapsed, shortest first as measured between (position,
    12 mm times normal), so that it is denser where the surface bends; a small mesh keeps its vertices. Then
    projection of the dense vertices x_i on the limit surface, A_i P, alternates with

        min_P  sum_i |A_i P - x_i|^2 + s N / C |L (P - P_0)|^2,  L the graph Laplacian, s small.
    """
    import igl

    start, control_faces, across = vertices, faces, vertex_normals(vertices, faces)
    if len(vertices) > 1.2 * size:
        lifted = np.asfortranarray(np.hstack([vertices, 12 * across]))
        target = int(len(faces) * size / len(vertices))
        collapsed, index, _, _ = igl.decimate(lifted, np.asfortranarray(faces.astype(np.int32)), target)
        start, control_faces = np.ascontiguousarray(collapsed[:, :3]), np.asarray(index, int)
    count = len(start)
    subdivision = LoopSubdivision.of(count, control_faces, 2)
    chosen = np.unique(np.linspace(0, len(vertices) - 1, min(len(vertices), 30_000)).astype(int))
    targets, normals = vertices[chosen], across[chosen]
    ring = adjacency(count, control_faces)
    valence = np.maximum(row_sums(ring), 1)
    smooth = sparse.identity(count) - sparse.diags(1 / valence) @ ring
    stiff = SMOOTHNESS * len(chosen) / count * (smooth.T @ smooth)
    control = start
    for _ in range(4):
        rows = subdivision.points_matrix(project(subdivision, control, targets, normals))
        control = factorized(rows.T @ rows + stiff)(rows.T @ targets + stiff @ start)
    return control, control_faces


def project(
    subdivision: LoopSubdivision, control: FloatArray, points: FloatArray, normals: FloatArray
) -> SurfacePoints:
    """Return where on the control faces the limit surface comes closest to points (N, 3) with normals."""
    hits = ClosestPointQuery(subdivision.matrix @ control, subdivision.faces).query_facing(points, normals)
    return subdivision.control_points(SurfacePoints(hits.face, hits.barycentric))
