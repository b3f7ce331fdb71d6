"""The Annotated Face Model: a Loop control mesh with regions, landmarks and one UV chart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ModelError
from scan2albedo.face_model.annotation import Region
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints
from scan2albedo.geometry.operators import linear_refinement

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LANDMARK_LEVELS = 3
"""Refinements at which landmarks and template vertices are evaluated (linear inside refined faces)."""


@dataclass(frozen=True)
class AnnotatedFaceModel:
    """A face template whose surface is the Loop limit surface of a control mesh.

    Parameters
    ----------
    control_vertices : (C, 3) float64
        Millimetres; +x the subject's left, +y up, +z out of the face, origin at the centroid.
    control_faces : (F, 3) int64
        Disc topology, counter-clockwise seen from outside.
    uv : (C, 2) float64
        One continuous flip-free chart in the unit square, u grows with +x, v with +y.
    region : (F,) uint8
        Region index of each control face.
    regions : mapping of str to Region
        By name.
    landmark_points : SurfacePoints, optional
        68 points in iBUG-68 order on the control faces; None for templates without landmarks.
    template_points : SurfacePoints, optional
        Where each vertex of the dense template lies (`from_mesh`).
    template_offset : (T, 3) float64, optional
        Template vertex minus its surface point at rest, in the surface point's local frame or zeros.
    template_faces : (T_F, 3) int64, optional
        The template's own triangles.
    template_from_model : (4, 4) float64, optional
        Similarity from the model's frame in mm to the axes, origin and unit that the template came in.
    notes : tuple of str
        What `from_mesh` decided and mended, one sentence each.
    name : str
        Used in messages and results.

    References
    ----------
    .. [1] I. Kakadiaris et al., "Three-Dimensional Face Recognition in the Presence of Facial
       Expressions: An Annotated Deformable Model Approach", IEEE PAMI 29(4), 2007.
    """

    control_vertices: FloatArray
    control_faces: IntArray
    uv: FloatArray
    region: NDArray[np.uint8]
    regions: Mapping[str, Region]
    landmark_points: SurfacePoints | None = None
    template_points: SurfacePoints | None = None
    template_offset: FloatArray | None = None
    template_faces: IntArray | None = None
    template_from_model: FloatArray | None = None
    notes: tuple[str, ...] = ()
    name: str = "annotated face model"
    _subdivisions: dict[int, LoopSubdivision] = field(default_factory=dict, repr=False, compare=False)
    _refined_uv: dict[int, FloatArray] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        count, faces = len(self.control_vertices), len(self.control_faces)
        if self.uv.shape != (count, 2):
            raise ModelError(f"{self.name}: uv has shape {self.uv.shape}, expected ({count}, 2)")
        if self.region.shape != (faces,):
            raise ModelError(f"{self.name}: region has shape {self.region.shape}, expected ({faces},)")
        known = {r.index for r in self.regions.values()}
        unknown = sorted(set(np.unique(self.region).tolist()) - known)
        if unknown:
            raise ModelError(
                f"{self.name}: faces carry region indices {unknown} that `regions` does not name"
            )

    def subdivision(self, levels: int) -> LoopSubdivision:
        """Return the (cached) limit-surface matrices after `levels` refinements."""
        if levels not in self._subdivisions:
            self._subdivisions[levels] = LoopSubdivision.of(
                len(self.control_vertices), self.control_faces, levels
            )
        return self._subdivisions[levels]

    def refined_uv(self, levels: int) -> FloatArray:
        """Return the (cached) chart (V, 2) at the vertices of `subdivision(levels)`, linear in each face."""
        if levels not in self._refined_uv:
            matrix = linear_refinement(len(self.control_vertices), self.control_faces, levels)
            self._refined_uv[levels] = matrix @ self.uv
        return self._refined_uv[levels].copy()

    def surface(self, levels: int = 2) -> tuple[FloatArray, IntArray]:
        """Return (vertices (V, 3), faces (F 4^levels, 3)) of the limit surface at rest."""
        subdivision = self.subdivision(levels)
        return subdivision.matrix @ self.control_vertices, subdivision.faces

    @cached_property
    def landmarks(self) -> FloatArray | None:
        """(68, 3) landmarks in mm on the limit surface at rest, iBUG-68 order; None when not annotated."""
        return self.landmarks_of(self.control_vertices)

    def landmarks_of(self, control_points: FloatArray) -> FloatArray | None:
        """Return the (68, 3) landmarks for deformed control points (C, 3)."""
        if self.landmark_points is None:
            return None
        return self.subdivision(LANDMARK_LEVELS).points_matrix(self.landmark_points) @ control_points

    def region_values(self, attribute: str) -> FloatArray:
        """Return (256,) table from region index to a Region attribute (0 where unused).

        >>> AnnotatedFaceModel.default().region_values("stiffness").shape
        (256,)
        """
        table = np.zeros(256)
        for region in self.regions.values():
            table[region.index] = float(getattr(region, attribute))
        return table

    def in_region(self, name: str) -> NDArray[np.bool_]:
        """Return (F_C,) which control faces lie in the region `name`; none where there is no such region."""
        if name not in self.regions:
            return np.zeros(len(self.control_faces), bool)
        return np.asarray(self.region == self.regions[name].index)

    @classmethod
    def default(cls) -> AnnotatedFaceModel:
        """Return the model that ships with the package (cached)."""
        return _default_model()

    @classmethod
    def load(cls, path: str | Path) -> AnnotatedFaceModel:
        """Read a model from its JSON file."""
        from scan2albedo.face_model.files import load_model

        return load_model(path)

    @classmethod
    def from_mesh(
        cls,
        vertices: FloatArray,
        faces: IntArray,
        uv: FloatArray | None = None,
        regions: Mapping[str, IntArray] | None = None,
        landmarks: FloatArray | IntArray | None = None,
        *,
        control_size: int = 1000,
        annotate: bool = True,
        name: str = "template",
    ) -> AnnotatedFaceModel:
        """Make an `AnnotatedFaceModel` from a dense face template of 100 to 100,000 vertices.

        The template is mended (unit, seams, loose parts, a few faces that spoil the surface, holes for eyes
        and mouth) and turned into the model's axes, its
        edges are collapsed to about `control_size` vertices, and these are moved until the Loop limit
        surface passes near the template. Every template vertex is placed on that surface, so that a fit
        returns the face in the template's own topology. Regions and landmarks that are not given are
        carried over from the default model, registered and fitted to the template.

        Parameters
        ----------
        vertices : (T, 3) array of float
            Micrometres, millimetres, centimetres or metres (decided by the size of a head); any axes when
            `annotate`, else +x the subject's left, +y up, +z out of the face.
        faces : (F, 3) array of int
            Triangles. Vertices without a face, or on loose parts (eyeballs), are carried along by the
            nearest surface.
        uv : (T, 2) array of float, optional
            One continuous chart; a new one is drawn when omitted or when it folds over.
        regions : mapping of str to array, optional
            Vertex indices, or a bool mask of T vertices or F faces, by name. The rest is region "face",
            what closes a hole of the template is region "filled"; these two names are taken. No scan pulls at
            a region named "between_lips", into which `annotate` puts what closes the mouth.
        landmarks : (68, 3) array of float or (68,) array of int, optional
            Points in the template's frame and unit, or vertex indices, iBUG-68 order.
        control_size : int
            Control vertices aimed at; a template not much larger keeps its own vertices. A template of the
            whole head spends most of them beside the face: 2500 do there what 1000 do for a face.
        annotate : bool
            Find the template's axes, and what annotation is not given, with the default model. Where no
            face is recognised in the template, its axes are taken as they are and `notes` says so.
        name : str
            Used in messages and results.

        Returns
        -------
        AnnotatedFaceModel
            In millimetres, origin at the centroid of the template's vertices in faces; the template's own
            axes where they are within 25 degrees of the convention's, else turned.

        Raises
        ------
        ModelError
            When the template, the regions or the landmarks cannot be used; the message says why.
        """
        from scan2albedo.applications.template_annotation import annotated_model
        from scan2albedo.face_model.from_mesh import DenseTemplate, model_from_surface
        from scan2albedo.face_model.template_surface import template_surface

        given = DenseTemplate(vertices, faces, uv, regions, landmarks, name)
        surface = template_surface(vertices, faces, name)
        make = annotated_model if annotate else model_from_surface
        return make(surface, given, control_size)

    def save(self, path: str | Path) -> None:
        """Write the model as JSON beside a small binary of its arrays."""
        from scan2albedo.face_model.files import save_model

        save_model(self, path)


@lru_cache(maxsize=1)
def _default_model() -> AnnotatedFaceModel:
    from importlib.resources import files

    return AnnotatedFaceModel.load(str(files("scan2albedo.face_model") / "data" / "afm.json"))
