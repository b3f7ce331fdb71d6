"""`GeometryImage`: a face sampled on a regular grid over its UV chart."""

from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arguments import require_linear
from scan2albedo.core.arrays import (
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
    all_finite,
    checked_array,
    checked_mesh,
    dots,
    grid_faces,
    norms,
    triangle_sides,
)
from scan2albedo.errors import GeometryImageError, errors_of

SMALLEST_SIZE = 8
"""Least texels a side: below it no face can be told."""
LARGEST_SIZE = 16384
"""Most texels a side: a texel takes some hundred bytes on its way, these are near 30 GB."""

NO_CAMERA = 255
"""In `GeometryImage.camera`: it is not known which camera took the texel."""

Occluder = tuple[FloatArray, IntArray]

ARRAYS = {
    "position": (float, 3),
    "normal": (float, 3),
    "mask": (np.bool_, None),
    "region": (np.uint8, None),
    "texture_linear": (np.float32, 3),
    "texture_valid": (np.bool_, None),
    "specular_scale": (np.float32, None),
    "inpaint": (np.bool_, None),
    "skin": (np.float32, None),
    "labels": (np.uint8, None),
    "camera": (np.uint8, None),
    "face_chart": (np.float32, 2),
    "filled": (np.bool_, None),
    "on_face": (np.bool_, None),
}
"""Type and channels, None for a plain (H, W), of the arrays that have a value a texel."""

_LENGTH = 0.01
"""Normals whose length differs from 1 by more are wrong; those shorter than this are not known."""


@dataclass(frozen=True)
class GeometryImage:
    """Position, normal, texture and annotation per texel; row 0 is v = 1 (the forehead).

    Raises GeometryImageError for shapes that disagree, values that are not finite inside the mask, skin
    beyond 0 to 1, a texture in integers, or an occluder that is not a mesh.
    """

    position: FloatArray
    """(H, W, 3): millimetres in the model's frame; zeros outside `mask`."""
    normal: FloatArray
    """(H, W, 3): unit outward normals; zeros outside `mask`."""
    mask: BoolArray
    """(H, W): texels that belong to the surface."""
    texture_linear: Float32Array | None = None
    """(H, W, 3): linear colour looked up on the raw scan."""
    region: ByteArray | None = None
    """(H, W): region index of the model's annotation; 255 outside `mask`."""
    occluder: Occluder | None = None
    """(vertices (V, 3), faces (F, 3)): mesh that casts shadows; triangulated from `position` when None."""
    texture_valid: BoolArray | None = None
    """(H, W): texels whose texture was really seen (not hidden, not at a grazing angle, not far from the
    scan); all of `mask` when None."""
    specular_scale: Float32Array | None = None
    """(H, W): expected relative strength of highlights from the annotation; 1 when None."""
    inpaint: BoolArray | None = None
    """(H, W): texels where the annotation permits inpainting; all of `mask` when None."""
    skin: Float32Array | None = None
    """(H, W): how surely a texel is skin, 0 to 1; 0 on hair, brows, eyes, lips, cloth and glasses, and where
    nothing was seen. When None it was not computed: every seen texel counts as 1."""
    labels: ByteArray | None = None
    """(H, W): what each texel is, by number in `scan2albedo.face_model.materials.CLASSES`; 0 is unseen."""
    camera: ByteArray | None = None
    """(H, W): number of the camera that took each texel; `NO_CAMERA` where it is not known."""
    camera_positions: FloatArray | None = None
    """(K, 3): where the cameras stood, millimetres in the model's frame; given along with `camera`."""
    face_chart: Float32Array | None = None
    """(H, W, 2): place (row, column, from 0 to 1) of each texel on the default model's chart, where facial
    features have known places; None: the image is not of a face."""
    texture_log_odds: float = 0.0
    """Natural logarithm of the odds that the texture belongs to this shape, by where brows, eyes and lips
    are; 0: nothing speaks for or against it."""
    filled: BoolArray | None = None
    """(H, W): texels that no picture showed, whose texture comes from around; none when None."""
    on_face: BoolArray | None = None
    """(H, W): texels of the annotated face, where light is sought; all of `mask` when None."""

    def __post_init__(self) -> None:
        mask = np.asarray(self.mask, bool)
        grid = mask.shape
        for field, (dtype, channels) in ARRAYS.items():
            value = getattr(self, field)
            if value is None:
                continue
            if field == "texture_linear":
                with errors_of(field, GeometryImageError, TypeError):
                    require_linear(field, value)
            array = np.ascontiguousarray(value)
            wanted = grid if channels is None else (*grid, channels)
            if len(grid) != 2 or array.shape != wanted:
                raise GeometryImageError(f"{field} has shape {array.shape}, expected {wanted} as the mask")
            array = array.astype(dtype, copy=False)
            if array.dtype.kind == "f" and not all_finite(array[mask]):
                raise GeometryImageError(f"{field} holds NaN or infinite values inside the mask")
            object.__setattr__(self, field, array)
        if self.skin is not None and not ((self.skin >= 0) & (self.skin <= 1))[self.mask].all():
            raise GeometryImageError("skin holds values beyond 0 to 1 inside the mask")
        if (self.camera is None) != (self.camera_positions is None):
            raise GeometryImageError("camera and camera_positions belong together, and one of them is None")
        if self.camera is not None:
            camera_positions, error = self.camera_positions, GeometryImageError
            positions = checked_array(camera_positions, ("K", 3), "camera_positions", error, finite=error)  # type: ignore[arg-type]
            unknown = (self.camera >= len(positions)) & (self.camera != NO_CAMERA)
            if unknown.any():
                raise GeometryImageError(
                    f"camera refers to number {self.camera[unknown].max()} of {len(positions)} cameras"
                )
            object.__setattr__(self, "camera_positions", positions)
        if self.occluder is not None:
            mesh = checked_mesh(*self.occluder, "occluder", GeometryImageError)
            object.__setattr__(self, "occluder", mesh)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.mask.shape

    @property
    def seen(self) -> BoolArray:
        """(H, W) texels of the surface whose texture can be trusted."""
        return self.mask if self.texture_valid is None else self.mask & self.texture_valid

    @property
    def face_side(self) -> float:
        """Longer side in texels of a chart that the face would fill alone, at the same size of texels."""
        if self.on_face is None or not self.on_face.any():
            return float(max(self.shape))
        return max(self.shape) * float(self.on_face.sum() / self.mask.sum()) ** 0.5

    @property
    def border(self) -> BoolArray:
        """(H, W) texels of the surface with a side neighbour outside it: the chart's rim, or its seams."""
        padded = np.pad(self.mask, 1)
        return self.mask & ~(padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:])

    def toward_camera(self, view_direction: ArrayLike) -> FloatArray:
        """Return (N, 3) unit directions from the texels of `mask` to their cameras, else `view_direction`."""
        position = self.position[self.mask]
        toward = np.broadcast_to(np.asarray(view_direction, float), position.shape).copy()
        if self.camera is None or self.camera_positions is None:
            return toward
        camera = self.camera[self.mask]
        known = camera != NO_CAMERA
        away = self.camera_positions[camera[known]] - position[known]
        toward[known] = away / np.maximum(np.sqrt(dots(away, away)), _LENGTH)[:, None]
        return toward

    def check_normals(self) -> None:
        """Raise `GeometryImageError` where normals are neither of length 1 nor 0 (not known): they shade."""
        length = norms(self.normal[self.mask])
        wrong = (np.abs(length - 1) > _LENGTH) & (length > _LENGTH)
        if wrong.any():
            raise GeometryImageError(
                f"{wrong.sum()} of {len(length)} normals have lengths from {length[wrong].min():.3g} to "
                f"{length[wrong].max():.3g}; divide them by their length, or give 0 where none is known"
            )

    def texel_areas_mm2(self) -> FloatArray:
        """Return (N,) surface per texel at all 2 x 2 blocks inside the mask: how evenly the chart samples."""
        whole = self.mask[:-1, :-1] & self.mask[:-1, 1:] & self.mask[1:, :-1] & self.mask[1:, 1:]
        down = (self.position[1:, 1:] - self.position[:-1, :-1])[whole]
        up = (self.position[:-1, 1:] - self.position[1:, :-1])[whole]
        return norms(np.cross(down, up)) / 2

    def figures(self) -> dict[str, float]:
        """Return what part of the square is surface, what part of that was seen, or is skin; texel areas."""
        areas = self.texel_areas_mm2()
        low, median, high = np.percentile(areas, (5, 50, 95)) if len(areas) else (np.nan,) * 3
        seen = float(self.seen.sum() / max(int(self.mask.sum()), 1))
        figures = {"coverage": float(self.mask.mean()), "seen": seen}
        if self.skin is not None:
            figures["skin"] = float(self.skin[self.mask].mean())
        if self.filled is not None:
            figures["filled"] = float(self.filled[self.mask if self.on_face is None else self.on_face].mean())
        if self.camera_positions is not None:
            figures["cameras"] = float(len(self.camera_positions))
        ratio = float(high / low) if low > 0 else float("nan")
        return figures | {"texel_area_mm2": float(median), "texel_area_p95_to_p5": ratio}

    def occluder_mesh(self) -> Occluder:
        """Return the mesh that casts shadows: `occluder`, or the texel grid triangulated."""
        return self.occluder if self.occluder is not None else self.triangulated()

    def triangulated(self) -> Occluder:
        """Return (vertices (V, 3) of the masked texels in row-major order, faces (F, 3)) of the texel grid.

        Each 2 x 2 block of masked texels gives two triangles, each wound to agree with `normal`.
        """
        index = np.full(self.shape, -1, int)
        index[self.mask] = np.arange(int(self.mask.sum()))
        faces = index.ravel()[grid_faces(*self.shape)]
        vertices = self.position[self.mask]
        # Face by face: a chart may be cut into pieces, some of them mirrored.
        return vertices, wound_like(vertices, faces[(faces >= 0).all(1)], self.normal[self.mask])


def wound_like(vertices: FloatArray, faces: IntArray, normals: FloatArray) -> IntArray:
    """Return the triangles (F, 3), each wound to agree with the normals (V, 3) at its corners."""
    corners = vertices[faces]
    outward = np.cross(*triangle_sides(corners))
    against = dots(outward, normals[faces].sum(1)) < 0
    return np.where(against[:, None], faces[:, ::-1], faces)


def check_size(size: int) -> None:
    """Raise GeometryImageError unless `size` is a whole number from `SMALLEST_SIZE` to `LARGEST_SIZE`."""
    if not isinstance(size, Integral) or not SMALLEST_SIZE <= size <= LARGEST_SIZE:
        said = f"size {size} does not suit a geometry image"
        raise GeometryImageError(f"{said}; give a whole number of texels, {SMALLEST_SIZE} to {LARGEST_SIZE}")
