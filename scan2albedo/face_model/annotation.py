"""An annotated surface: the limit surface of a Loop control mesh with regions, landmarks and one chart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import ModelError
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints
from scan2albedo.geometry.operators import linear_refinement

LANDMARK_LEVELS = 3
"""Refinements at which landmarks and template vertices are evaluated (linear inside refined faces)."""
MOUTH_REGION = "between_lips"
"""The film between the lips, which closes the model's surface. It is no skin: no scan pulls at it."""
SKIN_SHARE: Mapping[str, float] = MappingProxyType(
    {
        **dict.fromkeys(("left_brow", "right_brow"), 0.8),
        **dict.fromkeys(("left_eye", "right_eye", "left_nostril", "right_nostril", "lower_lip"), 0.7),
        MOUTH_REGION: 0.05,
    }
)
"""Part of a region that is skin on most faces, beside hair, eyes and lips; 1 in the regions not named."""
SKIN_REGIONS = frozenset({"forehead", "nose", "left_cheek", "right_cheek"})
"""Regions that show bare skin on most faces, bearded ones too."""


@dataclass(frozen=True)
class Region:
    """One annotated region of the face."""

    name: str
    """For example "nose" or "left_cheek" (the subject's left, +x)."""
    index: int
    """Value in `AnnotatedFaceModel.region`, 0 ... 254."""
    stiffness: float = 1.0
    """Relative stiffness in the fit, 1 = average; rigid parts (forehead, nose) are above."""
    specular_scale: float = 1.0
    """Relative strength of highlights expected there, 1 = average skin, 0 = none."""
    inpaint: bool = True
    """Whether saturated texels may be filled by exemplar synthesis there."""

    @property
    def skin_share(self) -> float:
        """Part of the region that is skin on most faces."""
        return SKIN_SHARE.get(self.name, 1.0)

    @property
    def shows_skin(self) -> bool:
        """Whether the region shows bare skin on most faces."""
        return self.name in SKIN_REGIONS


@dataclass(frozen=True)
class AnnotatedSurface:
    """A face template whose surface is the Loop limit surface of a control mesh [1]_.

    `control_vertices` (C, 3) in mm: +x the subject's left, +y up, +z out of the face, origin at the centroid.
    `control_faces` (F, 3) form a disc, counter-clockwise seen from outside. `uv` (C, 2) is one continuous
    flip-free chart in the unit square, u grows with +x, v with +y. `region` (F,) uint8 indexes the regions.
    `landmark_points` are 68 in iBUG-68 order on the control faces, or None.

    A surface made by `from_mesh` also has `template_points`, the place of each dense template vertex,
    `template_offset` (T, 3), vertex minus that surface point at rest in the point's local frame or zeros,
    `template_faces` (T_F, 3), where it has them `template_uv` (T_F, 3, 2), texture coordinates of their
    corners, `template_from_model` (4, 4), the similarity from the model's frame in mm to
    the template's own axes, origin and unit, and `notes`, a sentence for each thing decided and mended.

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
    template_uv: FloatArray | None = None
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
    def front(self) -> FloatArray:
        """(3,) mm: where the z axis leaves the face. There faces of every size are laid on the model."""
        vertices, _ = self.surface(1)
        # Of points as near to the axis, the foremost.
        return vertices[np.argmin(np.hypot(*vertices[:, :2].T) - 1e-6 * vertices[:, 2])]

    @cached_property
    def landmarks(self) -> FloatArray | None:
        """(68, 3) landmarks in mm on the limit surface at rest, iBUG-68 order; None when not annotated."""
        return self.landmarks_of(self.control_vertices)

    def landmarks_of(self, control_points: FloatArray) -> FloatArray | None:
        """Return the (68, 3) landmarks for deformed control points (C, 3)."""
        if self.landmark_points is None:
            return None
        return self.subdivision(LANDMARK_LEVELS).points_matrix(self.landmark_points) @ control_points

    def template_of(self, control_points: FloatArray) -> FloatArray | None:
        """Return the (T, 3) template vertices for deformed control points; None without a template.

        Each vertex is its point on the limit surface plus its rest offset, turned with its control face.
        """
        if self.template_points is None:
            return None
        moved = self.subdivision(LANDMARK_LEVELS).points_matrix(self.template_points) @ control_points
        if self.template_offset is None:
            return moved
        frames = surface_frames(control_points[self.control_faces[self.template_points.face]])
        return moved + np.einsum("nij,nj->ni", frames, self.template_offset)

    def region_values(self, attribute: str) -> FloatArray:
        """Return (256,) table from region index to a number of `Region` (0 where unused).

        >>> from scan2albedo import AnnotatedFaceModel
        >>> AnnotatedFaceModel.default().region_values("stiffness").shape
        (256,)
        """
        table = np.zeros(256)
        for region in self.regions.values():
            table[region.index] = float(getattr(region, attribute))
        return table

    def in_region(self, name: str) -> BoolArray:
        """Return (F_C,) which control faces lie in the region `name`; none where there is no such region."""
        if name not in self.regions:
            return np.zeros(len(self.control_faces), bool)
        return np.asarray(self.region == self.regions[name].index)


def surface_frames(corners: FloatArray) -> FloatArray:
    """Return (N, 3, 3) orthonormal frames of triangles (N, 3, 3); columns: first edge, in-plane, normal.

    A zero-area triangle gives zeros in the columns that are undefined, never NaN.
    """
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge, other)
    edge = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-300)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.stack([edge, np.cross(normal, edge), normal], axis=2)
