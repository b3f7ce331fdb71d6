"""What `register` works on: its settings, the scan and the face model, each prepared once for it.

The scan is checked, in its principal frame and sampled; the model has samples with weights and modes, and its
depth image.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import RegistrationError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.variation import shape_modes
from scan2albedo.geometry.mesh import far_faces, turned_against_neighbours
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.geometry.oriented_points import OrientedPoints, SurfaceNoise, anchors, oriented_points
from scan2albedo.geometry.rigid import in_principal_frame
from scan2albedo.registration.relief import FaceImage


@dataclass(frozen=True)
class RegistrationOptions:
    """Settings of `register`."""

    anchor_spacing_mm: float = 30.0
    """Distance between the scan points on which the front of the model is put."""
    kept_starts: int = 240
    """Starts that go on to the second search."""
    candidates: int = 8
    """Distinct poses that are refined, half of them where the first are no face; at least 6 to be safe."""
    settling_iterations: int = 30
    """Most iterations at the chosen pose until it settles."""
    annealing_evaluations: int = 400
    """Objective evaluations of the depth-derivative annealing where it is forced; 0 leaves it out."""
    force_annealing: bool = False
    """Anneal, and take its pose where the surface distance falls; else ICP's pose is the answer."""

    def __post_init__(self) -> None:
        if not 0 < self.anchor_spacing_mm < np.inf:
            raise ValueError(f"anchor_spacing_mm must be finite and above 0, got {self.anchor_spacing_mm}")
        counts = {"kept_starts": 1, "candidates": 1, "settling_iterations": 1, "annealing_evaluations": 0}
        for name, least in counts.items():
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} must be {least} or more, got {getattr(self, name)}")


SPACING_MM = 4.0
"""Of the samples."""


@dataclass(frozen=True)
class PreparedScan:
    """A scan in its principal frame, mm, without stray faces; `raw` is the scan as read, for messages.

    `samples` are spread over its whole surface, `anchors` are few of them far apart, with averaged normals.
    `prepared_from_scan` (4, 4) is the rigid transform from the scan's own frame.
    """

    vertices: FloatArray
    faces: IntArray
    samples: OrientedPoints
    anchors: OrientedPoints
    prepared_from_scan: FloatArray
    raw: RawScan

    @cached_property
    def turned_faces(self) -> int:
        """How many faces of the scan as read are wound against their neighbours."""
        return int(turned_against_neighbours(self.raw.faces).sum())

    @cached_property
    def noise(self) -> SurfaceNoise:
        """What its vertices say of the noise."""
        return SurfaceNoise.of(self.vertices, self.faces)

    def inside_out(self) -> PreparedScan:
        """Return the scan with the normals of its samples turned over."""
        turned = replace(self, samples=self.samples.inside_out(), anchors=self.anchors.inside_out())
        vars(turned)["noise"] = self.noise  # which normals do not change, and which takes long to measure
        return turned


def prepared_scan(scan: RawScan, options: RegistrationOptions) -> PreparedScan:
    """Check a scan's size and prepare it for the search.

    Raises `RegistrationError` when it has too few vertices or too little surface, or is larger than a room.
    """
    fewest = 50
    face_mm = 200
    largest_mm = 6000
    if (count := len(scan.vertices)) < fewest:
        advice = f"at least {fewest} are needed; scan the whole face"
        raise RegistrationError(f"{scan.name}: {count} vertices cannot show a face, {advice}")
    faces = scan.faces[~far_faces(scan.vertices, scan.faces)]
    corners = scan.vertices[faces].reshape(-1, 3)
    longest = float(np.ptp(corners, axis=0).max())
    power = round(float(np.log10(face_mm / longest))) if longest > 0 else 0
    unit = "Scan the whole face, and check the unit of the file"
    if power:
        unit = (
            "Check the unit of the file: vertices are taken as millimetres "
            f"(multiplied by {10.0**power:g} it would have the size of a face)"
        )
    if longest > largest_mm:
        raise RegistrationError(
            f"{scan.name}: the scan (box {box_text(corners)}) is too large: a face is about {face_mm} "
            f"mm, and it is looked for in at most {largest_mm // 1000} m. {unit}"
        )
    vertices, prepared_from_scan = in_principal_frame(scan.vertices, faces)
    samples = oriented_points(vertices, faces, SPACING_MM)
    if len(samples) < 150:
        raise RegistrationError(
            f"{scan.name}: its surface of {samples.areas.sum():.3g} mm2 (box {box_text(corners)}) is "
            f"too small for a face of about {face_mm} mm. {unit}"
        )
    # A scan of a whole room has too many anchors: it is searched more coarsely.
    spacing_mm = options.anchor_spacing_mm
    far_apart = anchors(samples, spacing=spacing_mm, limit=600, reach=1.5 * spacing_mm)
    return PreparedScan(vertices, faces, samples, far_apart, prepared_from_scan, scan)


def box_text(vertices: FloatArray) -> str:
    """Return the sides of the vertices' box for a message."""
    return " x ".join(f"{side:.3g}" for side in np.ptp(vertices, axis=0)) + " mm"


_WEIGHT_RANGE = (0.2, 3.0)


@dataclass(frozen=True)
class Template:
    """Samples of the face model, in its frame, mm, in random order (a prefix is a fair sample).

    `rigidity` (M,) is area times stiffness relative to the mean. `modes` (M, 3, K) are how people differ
    there, `control_modes` (K, C, 3) at the control points, which `surface_from_control` (V, C) takes to the
    vertices `surface` (V, 3) of the limit surface; `image` shows it at rest. `front` (3,) is the model's,
    `stiffness` (C,) the clipped relative one at the control points.
    """

    samples: OrientedPoints
    rigidity: FloatArray
    modes: FloatArray
    front: FloatArray
    image: FaceImage
    surface: FloatArray
    stiffness: FloatArray
    control_modes: FloatArray
    surface_from_control: csr_matrix

    @classmethod
    def of(cls, model: AnnotatedSurface, seed: int) -> Template:
        """Sample a model about every 6 mm; too few control vertices raise a `RegistrationError`.

        The answer is kept for as long as the model is.
        """
        key = (id(model), seed)
        if key in _KNOWN:
            return _KNOWN[key]
        if (count := len(model.control_vertices)) < 20:
            said = f"{model.name}: a model of {count} control vertices has no relief to find a face by"
            raise RegistrationError(f"{said}; at least 20 are needed, better some hundred")
        vertices, faces = model.surface(1)
        samples = oriented_points(vertices, faces, 6)
        samples = samples.subset(np.random.default_rng(seed).permutation(len(samples)))
        coarse_vertices, coarse_faces = model.surface(0)
        stiffness, of_face = np.ones(len(coarse_vertices)), model.region_values("stiffness")[model.region]
        if (mean := of_face.mean()) > 0:
            relative = np.clip(of_face / mean, *_WEIGHT_RANGE)
            stiffness = vertex_average(len(coarse_vertices), coarse_faces, relative)
        _, nearest = cKDTree(coarse_vertices).query(samples.points)
        rigidity = samples.areas * stiffness[nearest]
        # Its square: what moves with an expression shall not turn the rest, however large it is.
        steadiness = np.zeros(len(coarse_vertices))
        np.add.at(steadiness, nearest, rigidity * stiffness[nearest])
        modes, matrix = shape_modes(model, steadiness), model.subdivision(1).matrix
        _, point = cKDTree(vertices).query(samples.points)
        at_samples = matrix[point] @ modes.transpose(1, 2, 0).reshape(len(coarse_vertices), -1)
        sampled = samples, rigidity, at_samples.reshape(len(samples), 3, len(modes))
        image = FaceImage(vertices, faces)
        _KNOWN[key] = cls(*sampled, model.front, image, vertices, stiffness, modes, matrix)
        weakref.finalize(model, _KNOWN.pop, key, None)
        return _KNOWN[key]

    def in_shape(self, coefficients: FloatArray) -> Template:
        """Return the template moved by its modes times coefficients (K,); normals and image stay."""
        moved = np.tensordot(coefficients, self.control_modes, 1)
        samples = replace(self.samples, points=self.samples.points + self.modes @ coefficients)
        return replace(self, samples=samples, surface=self.surface + self.surface_from_control @ moved)

    def first(self, count: int) -> Template:
        """Return the template with its first `count` samples."""
        chosen = np.arange(min(count, len(self.samples)))
        rigidity, modes = self.rigidity[chosen], self.modes[chosen]
        return replace(self, samples=self.samples.subset(chosen), rigidity=rigidity, modes=modes)


_KNOWN: dict[tuple[int, int], Template] = {}
"""By the identity of the model and seed: thousands of scans are registered with one model."""
