"""Lenses before the eyes: scan that stands farther before them than any face does is set aside.

Lenses lie a centimetre before the eyes, and an elastic surface follows them. So a person's face, the modes by
which people differ, is first fitted with little weight for what lies before it; expressions hardly change
the face around the eyes, and what stands far before it there is no face. It leaves a hole, over which the
model keeps its own shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.variation import shape_modes
from scan2albedo.fitting.forces import ForceGates, scan_forces
from scan2albedo.fitting.openings import EYES
from scan2albedo.fitting.options import between
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.alignment import Alignment, Pairs, align
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import (
    boundary_vertex_mask,
    edges_with_faces,
    face_areas,
    normalized,
    vertex_areas,
    vertex_components,
    without_unreferenced,
)

STEPS = 10
REACH_MM = 20.0
"""Scan farther than this does not pull at the person's face."""
FIRST_MM, BEFORE_MM, BEHIND_MM = 12.0, 2.0, 6.0
"""Scale of Geman and McClure's weights: at first, and at last for scan before and behind the face."""
NOISE_MM, SIZE_SD = 2.6, 0.1
"""Standard deviation of the scan about a person's face that the modes make, and of the size's logarithm."""
FAR_MM, NEAR_MM = 5.5, 3.0
"""A cover stands FAR_MM before the face; with it goes what is joined to it and NEAR_MM before the face. Faces
without covers lie up to 5 mm before the person's face that is found for them; hair at the rim more."""
HIDING_MM, EYE_MM = 3.5, 8.0
"""Some of it lies HIDING_MM before an eye, this near to its middle: frames without lenses pull little."""
SUSPECT_MM = 4.0
"""Where no eye of the scan lies so far before the model's, nothing is looked for."""
STEEP, LEAST_STEPS = 0.6, 0.3
"""A step rises by STEEP of its length and more; so much of the cover's rim is steps or the scan's border. Of
lenses and frames half is, of a face with stronger brows than any person's that the modes make a tenth."""
LEAST_MM2 = 1500.0
"""Area of all covers together below which nothing is left out: two lenses have more; spikes, crumbs and brows
before a deep eye have less."""
ON_COVER_MM = 3.0
"""A point of the raw scan so near to a cover, and nearer than to the rest, is of the cover: thinning and
smoothing move the surface by less."""
FARTHEST_MM = 45.0
BELOW_EYES_MM = 18.0
"""Covers are looked for down to here, the lower rim of large lenses."""
BESIDE_NOSE_MM, NOSE_MM = 12.0, 3.0
"""Half width of the nose, whose height above the cheeks differs from person to person. Where most of it is
off the person's face by more than NOSE_MM that face is not the scan's, and nothing is judged by it."""
LEVEL = 1


@dataclass(frozen=True)
class Uncovered:
    """The scan without covers, the covers alone (None: there are none), and their area in mm^2."""

    scan: ScanSurface
    covers: ScanSurface | None = None
    covered_mm2: float = 0.0

    def of_covers(self, points: FloatArray) -> BoolArray:
        """Return (N,) which points of the whole scan lie on its covers."""
        if self.covers is None:
            return np.zeros(len(points), bool)
        distance = self.covers.nearest.query(points).distance
        near = distance < ON_COVER_MM
        near[near] = distance[near] <= self.scan.nearest.query(points[near]).distance
        return near


def uncovered(scan: ScanSurface, model: AnnotatedSurface, reference: FloatArray, meter: Meter) -> Uncovered:
    """Return the scan without what stands far before the eyes: lenses with their frame, a visor.

    `reference` (C, 3) are control points at rest, in the scan's frame and about of its size. Models without
    landmarks, which do not say where eyes are, get the scan as it is.
    """
    landmarks = model.landmarks_of(reference)
    if landmarks is None or meter.exhausted or not _may_be_covered(scan, model, reference, landmarks):
        return Uncovered(scan)
    person = persons_face(scan, model, reference)
    meter.count(STEPS)
    cover = _covers(scan, model, person)
    if not cover.any():
        return Uncovered(scan)
    gone = np.any(cover[scan.faces], axis=1)
    covered_mm2 = float(face_areas(scan.vertices, scan.faces[gone]).sum())
    if covered_mm2 < LEAST_MM2 or gone.all():
        return Uncovered(scan)
    border = np.zeros(len(cover), bool)
    border[scan.faces[gone]] = True
    return Uncovered(_part(scan, ~gone, border), _part(scan, gone, border), covered_mm2)


def _part(scan: ScanSurface, chosen: BoolArray, border: BoolArray) -> ScanSurface:
    """Return the faces `chosen` (F,) of a scan, whose new border are the vertices `border` (V,)."""
    kept, faces = without_unreferenced(scan.vertices, scan.faces[chosen])
    return ScanSurface(scan.vertices[kept], faces, scan.normals[kept], (scan.boundary | border)[kept])


def _may_be_covered(
    scan: ScanSurface, model: AnnotatedSurface, reference: FloatArray, landmarks: FloatArray
) -> bool:
    """Whether the scan's foremost point at one of the eyes lies `SUSPECT_MM` before the model's foremost."""
    surface = model.subdivision(LEVEL).matrix @ reference
    for eye in EYES:
        middle = landmarks[list(eye)].mean(0)
        here, there = (
            points[np.linalg.norm((points - middle)[:, :2], axis=1) < EYE_MM]
            for points in (surface, scan.vertices)
        )
        there = there[np.abs(there[:, 2] - middle[2]) < FARTHEST_MM]
        if len(there) and len(here) and there[:, 2].max() - here[:, 2].max() > SUSPECT_MM:
            return True
    return False


def persons_face(scan: ScanSurface, model: AnnotatedSurface, reference: FloatArray) -> FloatArray:
    """Return control points (C, 3) of the person's face nearest to the scan, but for what lies before it."""
    samples = SurfaceSamples.of(model, reference, 0)
    person = shape_modes(model, vertex_areas(model.control_vertices, model.control_faces))
    modes = person.transpose(1, 2, 0)
    gates = ForceGates(REACH_MM, 0.0, np.inf)

    def pairs(now: Alignment, points: FloatArray) -> Pairs | None:
        progress = now.steps / (STEPS - 1)
        normals = samples.normals(points)
        forces = scan_forces(scan, points, normals, gates)
        if not forces.weight.any():
            return None
        gap = np.einsum("ni,ni->n", forces.offset, forces.normal)
        before = np.einsum("ni,ni->n", forces.offset, normals) > 0
        ends = ((FIRST_MM, BEFORE_MM), (FIRST_MM, BEHIND_MM))
        scale = np.where(before, *(between(scales, progress) for scales in ends))
        trust = (forces.weight > 0) / (1 + (gap / scale) ** 2) ** 2
        return Pairs(forces.offset, forces.normal, trust, noise=NOISE_MM)

    found = align(
        samples.matrix @ reference,
        samples.area * samples.rigidity,
        pairs,
        steps=STEPS,
        modes=np.stack([samples.matrix @ modes[:, axis] for axis in range(3)], axis=1),
        precision=np.diag(np.concatenate([[SIZE_SD**-2], np.ones(len(person))])),
    )
    return found.pose.apply(reference + modes @ found.coefficients)


def _covers(scan: ScanSurface, model: AnnotatedSurface, person: FloatArray) -> BoolArray:
    """Return (V,) which vertices of the scan belong to a cover of the face with control points `person`."""
    # How far each vertex lies before the face, whether covers are looked for there, and if it is of the nose.
    subdivision = model.subdivision(LEVEL)
    points, faces = subdivision.matrix @ person, subdivision.faces
    hits = NearestSurface(points, faces).query(scan.vertices)
    normals, _ = surface_normals(points, faces)
    across = normalized(np.einsum("nk,nkj->nj", hits.barycentric, normals[faces[hits.face]]))
    before_mm = np.einsum("ij,ij->i", scan.vertices - hits.points, across)
    rim = boundary_vertex_mask(len(points), faces)
    beyond = np.where(rim[faces[hits.face]], hits.barycentric, 0.0).sum(1) > 0.5
    landmarks = model.landmarks_of(person)
    assert landmarks is not None
    x, y, _ = (hits.points - landmarks[28]).T
    slender = np.abs(x) < BESIDE_NOSE_MM
    nose = slender & (y < 0) & (hits.points[:, 1] > landmarks[33, 1]) & (np.abs(before_mm) < REACH_MM)
    lowest = landmarks[[40, 41, 46, 47], 1].mean() - BELOW_EYES_MM
    looked_at = (hits.points[:, 1] > lowest) & ~(slender & (y < 0)) & ~beyond & (before_mm < FARTHEST_MM)
    if not nose.any() or abs(float(np.median(before_mm[nose]))) > NOSE_MM:
        return np.zeros(len(nose), bool)
    near = looked_at & (before_mm > NEAR_MM)
    part = vertex_components(len(near), scan.faces[near[scan.faces].all(1)])
    eyes = np.array([landmarks[list(eye)].mean(0) for eye in EYES])
    aside = np.linalg.norm(scan.vertices[:, None, :2] - eyes[:, :2], axis=2).min(1)
    far, hides = np.zeros((2, part.max() + 1), bool)
    far[part[near & (before_mm > FAR_MM)]] = True
    hides[part[near & (before_mm > HIDING_MM) & (aside < EYE_MM)]] = True
    cover = near & (far & hides)[part]
    # A cover ends as a thing does: at the scan's border, or by steps. A brow rises gradually.
    edges, _ = edges_with_faces(scan.faces)
    across_end = edges[cover[edges[:, 0]] != cover[edges[:, 1]]].T
    length = np.linalg.norm(scan.vertices[across_end[0]] - scan.vertices[across_end[1]], axis=1)
    steps = np.abs(before_mm[across_end[0]] - before_mm[across_end[1]]) > STEEP * length
    ends = int((scan.boundary & cover).sum())
    if not steps.sum() + ends > LEAST_STEPS * (len(steps) + ends):
        return np.zeros(len(near), bool)
    around = cover.copy()
    around[edges[cover[edges].any(1)]] = True
    return around
