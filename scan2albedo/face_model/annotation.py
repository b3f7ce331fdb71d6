"""An annotated surface: the limit surface of a Loop control mesh with regions, landmarks and one chart.

On disk it is `afm.json` with the annotation, and an .npz beside it with the arrays.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Texts, Values, triangle_sides
from scan2albedo.errors import ModelError
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.io.npz import Arrays, read_npz, write_npz
from scan2albedo.io.records import Count, PositiveCount, read_record, write_record

LANDMARK_LEVELS = 3
"""Refinements at which landmarks and template vertices are evaluated (linear inside refined faces)."""
MOUTH_REGION = "between_lips"
"""The film between the lips, which closes the model's surface. It is not skin: no scan pulls at it."""
REST_REGION = "face"
"""Of models made from templates: what is in no region."""
FILLED_REGION = "filled"
"""Of models made from templates: the faces over the template's own holes."""
SKIN_SHARE = {
    **dict.fromkeys(("left_brow", "right_brow"), 0.8),
    **dict.fromkeys(("left_eye", "right_eye", "left_nostril", "right_nostril", "lower_lip"), 0.7),
    MOUTH_REGION: 0.05,
}
"""Part of a region that is skin on most faces, beside hair, eyes and lips; 1 in the regions not named."""


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


@dataclass(frozen=True)
class AnnotatedSurface:
    """A face template whose surface is the Loop limit surface of a control mesh [1]_.

    `control_vertices` (C, 3) in mm: +x the subject's left, +y up, +z out of the face, origin at the centroid.
    `control_faces` (F, 3) form a disc, counter-clockwise seen from outside. `uv` (C, 2) is one continuous
    flip-free chart in the unit square, u grows with +x, v with +y. `region` (F,) uint8 indexes the `regions`.
    `landmark_points` are 68 in iBUG-68 order on the control faces, or None.

    A surface made by `from_mesh` also has `template_points`, the place of each dense template vertex,
    `template_offset` (T, 3), vertex minus that surface point at rest in the point's local frame or zeros,
    `template_faces` (T_F, 3), where it has them `template_uv` (T_F, 3, 2), texture coordinates of their
    corners, `template_from_model` (4, 4), the similarity from the model's frame in mm to
    the template's own axes, origin and unit, `notes`, a sentence for each thing decided and mended, `name`.
    `face_uv` (C, 2) are the places of the control vertices on the default model's chart: its own `uv`, or
    what the annotation of a template found; None where no face was recognised.

    .. [1] I. Kakadiaris et al., "Three-Dimensional Face Recognition in the Presence of Facial
       Expressions: An Annotated Deformable Model Approach", IEEE PAMI 29(4), 2007.
    """

    control_vertices: FloatArray
    control_faces: IntArray
    uv: FloatArray
    region: ByteArray
    regions: Mapping[str, Region]
    landmark_points: SurfacePoints | None = None
    template_points: SurfacePoints | None = None
    template_offset: FloatArray | None = None
    template_faces: IntArray | None = None
    template_uv: FloatArray | None = None
    template_from_model: FloatArray | None = None
    face_uv: FloatArray | None = None
    notes: Texts = ()
    name: str = "annotated face model"
    _subdivisions: dict[int, LoopSubdivision] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        count, faces = len(self.control_vertices), len(self.control_faces)
        if self.uv.shape != (count, 2):
            raise ModelError(f"{self.name}: uv has shape {self.uv.shape}, expected ({count}, 2)")
        if self.region.shape != (faces,):
            raise ModelError(f"{self.name}: region has shape {self.region.shape}, expected ({faces},)")
        unknown = sorted(set(np.unique(self.region).tolist()) - {r.index for r in self.regions.values()})
        if unknown:
            raise ModelError(f"{self.name}: faces have region indices {unknown} that `regions` does not name")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model from its JSON file; raises `ModelError` when files are damaged or do not match."""
        advice = "give the .json file of a model (data_schemas/annotated_face_model.schema.json)"
        entry = read_record(path, FaceModelFile, what="face model", advice=advice, error=ModelError)
        file = Path(path).with_name(entry.arrays)
        advice = "copy it beside its .json file again"
        arrays = read_npz(file, what="face model", advice=advice, error=ModelError)
        # The arrays must be those that the .json file describes.
        optional = ("template_offset", "template_from_model", "template_uv", "face_uv")
        for name, (_, sides) in _STORED.items():
            shape = tuple(side if isinstance(side, int) else getattr(entry, side) for side in sides)
            got = arrays[name].shape if name in arrays else None
            needed = shape[0] > 0 and name not in optional
            if got != shape and (got is not None or needed):
                state = "missing" if got is None else f"of shape {got}"
                raise ModelError(
                    f"face model: {name} in {file} is {state}, the .json file says {shape}; "
                    "the two files do not belong together"
                )
        for name, values in arrays.items():
            if values.dtype.kind == "f" and not np.all(np.isfinite(values)):
                raise ModelError(f"face model: {name} in {file} holds NaN or infinite values")
        for name, limit in {
            "control_faces": entry.control_vertices,
            "landmark_face": entry.control_faces,
            "template_face": entry.control_faces,
            "template_faces": entry.template_vertices,
        }.items():
            if name in arrays and not ((arrays[name] >= 0) & (arrays[name] < limit)).all():
                raise ModelError(f"face model: {name} in {file} points outside 0 ... {limit - 1}")
        found: Values = {
            name: arrays[name].astype(np.int64 if kind is np.int32 else kind)
            for name, (kind, _) in _STORED.items()
            if name in arrays
        }
        for prefix in ("landmark", "template"):
            if f"{prefix}_face" in found:
                points = SurfacePoints(found.pop(f"{prefix}_face"), found.pop(f"{prefix}_barycentric"))
                found[f"{prefix}_points"] = points
        regions = {name: Region(name, **region.model_dump()) for name, region in entry.regions.items()}
        return cls(**found, regions=regions, notes=tuple(entry.notes), name=entry.name)

    def save(self, path: str | Path) -> None:
        """Write `path` (.json) and, beside it, the arrays in `<stem>.npz`; same model, same bytes."""
        file, own = Path(path).with_suffix(".npz"), dict(vars(self))
        for prefix in ("landmark", "template"):
            if (points := own[f"{prefix}_points"]) is not None:
                own |= {f"{prefix}_face": points.face, f"{prefix}_barycentric": points.barycentric}
        arrays: Arrays = {
            name: own[name].astype(kind) for name, (kind, _) in _STORED.items() if own.get(name) is not None
        }
        entry = FaceModelFile(
            format="scan2albedo-afm-1",
            name=self.name,
            arrays=file.name,
            control_vertices=len(self.control_vertices),
            control_faces=len(self.control_faces),
            landmarks=68 if self.landmark_points is not None else 0,
            template_vertices=len(arrays.get("template_face", ())),
            template_faces=len(arrays.get("template_faces", ())),
            notes=list(self.notes),
            regions={
                name: RegionEntry(**{key: value for key, value in vars(region).items() if key != "name"})
                for name, region in self.regions.items()
            },
        )
        write_npz(file, arrays, what="face model", compression=6)
        write_record(path, entry)

    def subdivision(self, levels: int) -> LoopSubdivision:
        """Return the (cached) limit-surface matrices after `levels` refinements."""
        if levels not in self._subdivisions:
            count = len(self.control_vertices)
            self._subdivisions[levels] = LoopSubdivision.of(count, self.control_faces, levels)
        return self._subdivisions[levels]

    def refined_uv(self, levels: int) -> FloatArray:
        """Return the chart (V, 2) at the vertices of `subdivision(levels)`, linear in each face."""
        return linear_refinement(len(self.uv), self.control_faces, levels) @ self.uv

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
        """Return the (T, 3) template vertices for deformed control points; None without a template."""
        if self.template_points is None:
            return None
        moved = self.subdivision(LANDMARK_LEVELS).points_matrix(self.template_points) @ control_points
        if self.template_offset is None:
            return moved
        frames = surface_frames(control_points[self.control_faces[self.template_points.face]])
        return moved + np.einsum("nij,nj->ni", frames, self.template_offset)

    def region_values(self, attribute: str) -> FloatArray:
        """Return (256,) table from region index to a number of `Region` (0 where unused)."""
        table = np.zeros(256)
        for region in self.regions.values():
            table[region.index] = float(getattr(region, attribute))
        return table

    def face_regions(self) -> BoolArray:
        """Return (256,) which region indices are the face's: all, unless a template is annotated in part."""
        rest = [self.regions[name].index for name in (REST_REGION, FILLED_REGION) if name in self.regions]
        annotated = self.template_points is not None and not np.isin(self.region, rest).all()
        return ~np.isin(np.arange(256), rest) if annotated else np.ones(256, bool)

    def in_region(self, name: str) -> BoolArray:
        """Return (F_C,) which control faces lie in the region `name`; none where there is no such region."""
        if name not in self.regions:
            return np.zeros(len(self.control_faces), bool)
        return self.region == self.regions[name].index


@dataclass(frozen=True)
class FittedSurface:
    """A model deformed onto a scan, as `sampling` needs it; in the model's frame, mm."""

    vertices: FloatArray
    """(V, 3): limit surface points, V from `levels` refinements of the control mesh."""
    faces: IntArray
    """(F, 3)."""
    uv: FloatArray
    """(V, 2): chart coordinates of `vertices`."""
    region: ByteArray
    """(F,): region index of each face."""
    residual_mm: FloatArray
    """(V,): distance of each vertex to the scan; NaN where the scan has no surface near (hole, outside)."""
    model_from_scan: FloatArray
    """(4, 4): pose used; the fit may refine it."""
    levels: int
    """Loop refinements of `vertices`."""
    model: AnnotatedSurface
    """That was fitted."""


def surface_frames(corners: FloatArray) -> FloatArray:
    """Return (N, 3, 3) orthonormal frames of triangles (N, 3, 3); columns: first edge, in-plane, normal.

    A zero-area triangle gives zeros in the columns that are undefined, never NaN.
    """
    edge, other = triangle_sides(corners)
    edge, normal = normalized(edge), normalized(np.cross(edge, other))
    return np.stack([edge, np.cross(normal, edge), normal], axis=2)


@lru_cache(maxsize=1)
def default_model() -> AnnotatedSurface:
    """Return the model that ships with the package (cached)."""
    model = AnnotatedSurface.load(str(files("scan2albedo.face_model") / "data" / "afm.json"))
    return replace(model, face_uv=model.uv)


_STORED: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "control_vertices": (float, ("control_vertices", 3)),
    "control_faces": (np.int32, ("control_faces", 3)),
    "uv": (float, ("control_vertices", 2)),
    "region": (np.uint8, ("control_faces",)),
    "template_offset": (float, ("template_vertices", 3)),
    "template_from_model": (float, (4, 4)),
    "template_faces": (np.int32, ("template_faces", 3)),
    "template_uv": (float, ("template_faces", 3, 2)),
    "face_uv": (float, ("control_vertices", 2)),
    "landmark_face": (np.int32, ("landmarks",)),
    "landmark_barycentric": (float, ("landmarks", 3)),
    "template_face": (np.int32, ("template_vertices",)),
    "template_barycentric": (float, ("template_vertices", 3)),
}
"""Type on disk, and shape by numbers that `FaceModelFile` gives; integers have 64 bits in memory."""


class RegionEntry(BaseModel):
    """One region, as in `annotation.Region`."""

    model_config = ConfigDict(extra="forbid")

    index: int = Field(ge=0, le=254, description="value of the `region` array")
    stiffness: float = Field(gt=0, description="relative stiffness in the fit, 1 = average")
    specular_scale: float = Field(ge=0, description="relative strength of highlights, 1 = average skin")
    inpaint: bool = Field(description="whether saturated texels may be filled there")


class FaceModelFile(BaseModel):
    """Annotated Face Model: its annotation, and which arrays its .npz file holds.

    These are control_vertices (C, 3) mm, control_faces (F, 3), uv (C, 2), region (F,), and where the counts
    below are not 0 landmark_face (68,) with landmark_barycentric (68, 3), template_face (T,),
    template_barycentric (T, 3), template_offset (T, 3), template_faces (T_F, 3), template_uv (T_F, 3, 2),
    template_from_model (4, 4); where a face was recognised, face_uv (C, 2) on the default model's chart.
    """

    model_config = ConfigDict(extra="forbid", title="scan2albedo annotated face model")

    format: Literal["scan2albedo-afm-1"] = Field(description="name and version of this format")
    name: str
    unit: Literal["mm"] = "mm"
    frame: Literal["+x subject's left, +y up, +z out of the face"] = (
        "+x subject's left, +y up, +z out of the face"
    )
    arrays: str = Field(description="file name of the .npz, in the same folder", pattern=r"^[^/\\]+\.npz$")
    control_vertices: int = Field(ge=3, description="C")
    control_faces: PositiveCount = Field(description="F")
    landmarks: Literal[0, 68] = Field(description="0, or 68 in iBUG order")
    template_vertices: Count = Field(description="T, 0 when the model carries no dense template")
    template_faces: Count = Field(description="T_F")
    notes: list[str] = Field(default=[], description="what was decided and mended when the model was made")
    regions: dict[str, RegionEntry] = Field(description="by name, for example left_cheek")
