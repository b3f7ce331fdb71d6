"""Lenses before the eyes: scan that stands farther before them than any face does is set aside.

Lenses lie a centimetre before the eyes, and an elastic surface follows them. So a person's face, the modes by
which people differ, is first fitted with little weight for what lies before it. What stands before it and an
eye is a cover or not by one sum of log odds: ends like a thing's speak for it, heights that faces have and
how rare covers are against it. A cover leaves a hole, over which the model keeps its own shape.
"""

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray, dots, norms
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.variation import shape_modes
from scan2albedo.fitting.forces import ForceGates, scan_forces
from scan2albedo.fitting.landmark_pull import EYES
from scan2albedo.fitting.options import between
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry import mesh
from scan2albedo.geometry.alignment import Alignment, Pairs, align
from scan2albedo.statistics.robust import geman_mcclure_weights

STEPS = 10
"""Iterations of the alignment with a person's face."""
NOISE_MM = 2.6
"""Standard deviation of the scan about a person's face that the modes make."""
SIZE_SD = 0.1
"""Standard deviation of the logarithm of a face's size."""
FARTHEST_MM = 45.0
"""Covers stand anywhere from the face to here; scan farther than this does not pull at the person's face."""
EYE_MM = 8.0
"""A cover lies before an eye, this near to its middle; squares of this side err for themselves."""
BELOW_EYES_MM = 18.0
"""Covers are looked for so far down: to the lower rim of large lenses."""
STEEP = 0.6
"""A jump rises by this part of its length and more."""
JUMPS_AT_END = 0.27
"""Share of a cover's ends that are jumps or the scan's border which speaks for neither. Half of a cover's
ends are such, of a face's a tenth."""
PER_JUMPS = 11.0
"""Log odds of a cover for a share that is 1 higher."""
RARE = 7.0
"""Log odds against covers, and against people's faces that stand so far before what the modes make."""


def uncovered(
    scan: ScanSurface, model: AnnotatedSurface, reference: FloatArray, meter: Meter
) -> tuple[ScanSurface, ScanSurface | None]:
    """Return the scan without what stands far before the eyes (lenses with their frame, a visor), and that.

    `reference` (C, 3) are control points at rest, in the scan's frame and about of its size. Models without
    landmarks, which do not say where eyes are, get the scan as it is.
    """
    if model.landmark_points is None or meter.exhausted or not _covers(scan, model, reference).any():
        return scan, None
    cover = _covers(scan, model, persons_face(scan, model, reference))
    meter.count(STEPS)
    gone = np.any(cover[scan.faces], axis=1)
    if not gone.any() or gone.all():
        return scan, None
    border = mesh.vertex_mask(len(cover), scan.faces[gone])
    return _part(scan, ~gone, border), _part(scan, gone, border)


def _part(scan: ScanSurface, chosen: BoolArray, border: BoolArray) -> ScanSurface:
    """Return the faces `chosen` (F,) of a scan, whose new border are the vertices `border` (V,)."""
    kept, faces = mesh.without_unreferenced(scan.vertices, scan.faces[chosen])
    return ScanSurface(scan.vertices[kept], faces, scan.normals[kept], (scan.boundary | border)[kept])


def persons_face(scan: ScanSurface, model: AnnotatedSurface, reference: FloatArray) -> FloatArray:
    """Return control points (C, 3) of the person's face nearest to the scan, but for what lies before it."""
    samples = SurfaceSamples.of(model, reference, 0)
    person = shape_modes(model, mesh.vertex_areas(model.control_vertices, model.control_faces))
    modes = person.transpose(1, 2, 0)
    gates = ForceGates(FARTHEST_MM, 0.0, np.inf)

    def pairs(now: Alignment, points: FloatArray) -> Pairs | None:
        normals = samples.normals(points)
        forces = scan_forces(scan, points, normals, gates)
        if not forces.weight.any():
            return None
        gap = dots(forces.offset, forces.normal)
        before = dots(forces.offset, normals) > 0
        # 12 mm at first, 2 mm at last for scan before the face, 6 mm behind.
        scale = np.where(before, *(between((12.0, last), now.steps / (STEPS - 1)) for last in (2.0, 6.0)))
        trust = (forces.weight > 0) * geman_mcclure_weights(gap, scale)
        return Pairs(forces.offset, forces.normal, trust, noise=NOISE_MM)

    rest, weights = samples.matrix @ reference, samples.area * samples.rigidity
    moves = np.stack([samples.matrix @ modes[:, axis] for axis in range(3)], axis=1)
    precision = np.diag(np.concatenate([[SIZE_SD**-2], np.ones(len(person))]))
    found = align(rest, weights, pairs, steps=STEPS, modes=moves, precision=precision)
    return found.pose.apply(reference + modes @ found.coefficients)


def _covers(scan: ScanSurface, model: AnnotatedSurface, person: FloatArray) -> BoolArray:
    """Return (V,) which vertices of the scan belong to covers of the face with control points `person`."""
    subdivision, landmarks = model.subdivision(1), model.landmarks_of(person)
    assert landmarks is not None
    points, faces = subdivision.matrix @ person, subdivision.faces
    rim = mesh.boundary_vertex_mask(len(points), faces)
    face = ScanSurface(points, faces, surface_normals(points, faces)[0], rim)
    hits = face.nearest.query(scan.vertices)
    before_mm = dots(scan.vertices - hits.points, mesh.normalized(face.normals_at(hits)))
    # How far off the nose is, which no lens covers, shows how well the person's face is known.
    x, y, _ = (hits.points - landmarks[28]).T
    nose = (np.abs(x) < (landmarks[35, 0] - landmarks[31, 0]) / 2) & (y < 0)
    shown = before_mm[nose & (hits.points[:, 1] > landmarks[33, 1]) & (np.abs(before_mm) < FARTHEST_MM)]
    deviation_mm = np.hypot(NOISE_MM, np.median(shown)) if len(shown) else FARTHEST_MM
    lowest_mm = landmarks[[40, 41, 46, 47], 1].mean() - BELOW_EYES_MM - landmarks[28, 1]
    near = (before_mm > deviation_mm) & (before_mm < FARTHEST_MM)
    near &= (y > lowest_mm) & ~nose & ~face.on_boundary(hits)
    part = mesh.vertex_components(len(near), scan.faces[near[scan.faces].all(1)])
    eyes = np.array([landmarks[list(eye)].mean(0) for eye in EYES])
    aside = norms(scan.vertices[:, None, :2] - eyes[:, :2]).min(1)
    cover = near & np.isin(part, part[near & (aside < EYE_MM)])
    if not cover.any():
        return cover
    # Heights are normal about a face that the modes make, and even before covers and other faces.
    even = np.log(2 * np.pi * (deviation_mm / FARTHEST_MM) ** 2)
    odds = (even + (before_mm[cover] / deviation_mm) ** 2) / 2
    by_heights = float(mesh.vertex_areas(scan.vertices, scan.faces)[cover] @ odds) / EYE_MM**2
    # A cover ends as a thing does: at the scan's border, or by jumps. A brow rises gradually.
    edges, _ = mesh.edges_with_faces(scan.faces)
    one, other = edges[cover[edges[:, 0]] != cover[edges[:, 1]]].T
    length_mm = norms(scan.vertices[one] - scan.vertices[other])
    jumps = np.abs(before_mm[one] - before_mm[other]) > STEEP * length_mm
    share = np.append(jumps, np.ones(1 + np.count_nonzero(scan.boundary & cover))).mean()
    log_odds = min(by_heights - RARE, 0.0) + PER_JUMPS * (share - JUMPS_AT_END)
    cover[edges[cover[edges].any(1)]] = True
    return cover & (log_odds > 0)
