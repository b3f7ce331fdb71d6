"""`RawScan`: a textured triangle mesh as a scanner delivers it, in millimetres and linear colour."""

import hashlib
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from scan2albedo.core.arguments import linear_doubt, require_linear
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, GridShape, IntArray, Texts
from scan2albedo.core.landmarks import LARGEST_COORDINATE, PlacedLandmarks
from scan2albedo.errors import ScanError, one_line, printable

_LARGEST_UV = 1e12
LONGEST_NAME = 200
"""Bytes of the name of a result's folder: names of files made from it may have 255."""


def scan_name(file: str | Path) -> str:
    """Return the name that a scan has after its file: the stem, where that can name a folder everywhere.

    In others, slashes and what `printable` would escape become "_", and so does a dot in front; what is too
    long is cut. A hash of the whole stem then keeps names apart.

    >>> scan_name("scans/anna.obj"), scan_name("scans/an\\x1b[31mna.obj")
    ('anna', 'an_[31mna-cf59b66c')
    """
    stem = Path(file).stem
    plain = re.sub(r"\\x[0-9a-f]{2}|\\u[0-9a-f]{4}|[/\\]", "_", printable(stem))
    if stem == "" or stem.startswith("."):
        plain = f"_{plain[1:]}"
    if plain == stem and len(stem.encode()) <= LONGEST_NAME:
        return stem
    digest = hashlib.sha256(stem.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return f"{plain.encode()[: LONGEST_NAME - 9].decode('utf-8', 'ignore')}-{digest}"


def is_folder_name(name: str) -> bool:
    """Return whether results can get a folder of that name."""
    fitting = name == printable(name) and len(name.encode("utf-8", "replace")) <= LONGEST_NAME
    return fitting and not name.startswith(".") and name != "" and not set(name) & set("/\\")


def lost_texture(notes: Iterable[str]) -> str | None:
    """Return the first note that says that a texture or its material was not found; None without one."""
    return next((note for note in notes if "went on without" in note), None)


def require_valid_indices(faces: IntArray, vertex_count: int, name: str) -> None:
    """Raise `ScanError` when a face refers to a vertex that is not there."""
    low, high = int(faces.min(initial=0)), int(faces.max(initial=-1))
    if low < 0 or high >= vertex_count:
        raise ScanError(
            f"{name}: a face refers to vertex {low if low < 0 else high}, but there are {vertex_count} "
            "vertices (counting from 0); the file is damaged or truncated: export it again"
        )


@dataclass(frozen=True)
class TextureTile:
    """One of several pictures that a texture was packed of: its material's name, and its place in pixels."""

    name: str
    left: int
    top: int
    width: int
    height: int

    def holds(self, uv: FloatArray, shape: GridShape) -> BoolArray:
        """Return (F,) which faces, by their corners' coordinates (F, 3, 2), lie on it in a texture (H, W)."""
        across, down = self.own_uv(uv.mean(1), shape).T
        return (across >= 0) & (across <= 1) & (down >= 0) & (down <= 1)

    def own_uv(self, uv: FloatArray, shape: GridShape) -> FloatArray:
        """Return coordinates of the texture (H, W) as those of this picture alone."""
        across = (uv[..., 0] * shape[1] - self.left) / self.width
        down = ((1 - uv[..., 1]) * shape[0] - self.top) / self.height
        return np.stack([across, 1 - down], axis=-1)


@dataclass(frozen=True)
class RawScan:
    """A raw scan; inputs are checked and converted, never mutated.

    Raises ScanError for wrong shapes, no faces, an empty texture, non-finite or absurdly large numbers, face
    indices out of range, a unit of no length, or a name that names no folder; TypeError for colours in
    integers. Warns of colours that are hardly linear light, and says so in `notes`, once.
    """

    vertices: FloatArray
    """(V, 3): millimetres, any pose."""
    faces: IntArray
    """(F, 3): indices into `vertices`."""
    uv: FloatArray | None = None
    """(F, 3, 2): texture coordinates of each face's corners; v = 0 is the bottom row of the texture."""
    texture_linear: Float32Array | None = None
    """(H, W, 3): linear colour, 1 = display white; row 0 is the top."""
    vertex_color_linear: Float32Array | None = None
    """(V, 3): linear colour of each vertex, for scans without a texture."""
    color_seen: BoolArray | None = None
    """Which colours a picture showed: (H, W) of the texture, else (V,) of the vertices; all when None. The
    others are transparent, or were filled in: nothing is concluded from them."""
    name: str = "scan"
    """Used in messages and output folders."""
    notes: Texts = ()
    """What loading decided and repaired (unit, dropped faces, missing texture), one sentence each."""
    mm_per_unit: float = 1.0
    """Millimetres per unit of the file that it was read from."""
    texture_tiles: tuple[TextureTile, ...] = ()
    """Of which pictures the texture was packed; none where it is one picture."""
    landmarks: PlacedLandmarks | None = None
    """Points that someone placed on it: soft constraints of its registration and fit."""

    def __post_init__(self) -> None:
        if not is_folder_name(self.name):
            said = f"a scan cannot be named {self.name!r}: its results get a folder of that name"
            raise ScanError(f"{said}; give another `name` of up to {LONGEST_NAME} bytes")
        object.__setattr__(self, "notes", tuple(map(one_line, self.notes)))
        if self.landmarks is not None:
            object.__setattr__(self, "landmarks", PlacedLandmarks.of(self.landmarks))
        if not 0 < self.mm_per_unit < np.inf:
            raise ScanError(f"{self.name}: mm_per_unit is {self.mm_per_unit}, expected a length above 0")
        vertices = self._checked("vertices", float, (None, 3))
        faces = self._checked("faces", int, (None, 3))
        if len(faces) == 0:
            raise ScanError(f"{self.name}: no faces ({len(vertices)} vertices); a surface mesh is needed")
        require_valid_indices(faces, len(vertices), self.name)
        if (reach := float(np.abs(vertices).max(initial=0.0))) > LARGEST_COORDINATE:
            said = f"{self.name}: a coordinate is {reach:.3g}, beyond {LARGEST_COORDINATE:g}"
            raise ScanError(f"{said}; the file is damaged: repair or re-export the scan")
        if self.color_seen is not None:
            textured = self.uv is not None and self.texture_linear is not None
            grid = self.texture_linear.shape[:2] if textured else (len(vertices),)  # type: ignore[union-attr]
            self._checked("color_seen", np.bool_, grid)
        for field, dtype, shape in (
            ("uv", float, (len(faces), 3, 2)),
            ("texture_linear", np.float32, (None, None, 3)),
            ("vertex_color_linear", np.float32, (len(vertices), 3)),
        ):
            if (value := getattr(self, field)) is not None:
                if dtype is np.float32:
                    require_linear(f"{self.name}: {field}", value)
                self._checked(field, dtype, shape)
        if self.uv is not None and (reach := float(np.abs(self.uv).max())) > _LARGEST_UV:
            raise ScanError(
                f"{self.name}: a texture coordinate is {reach:.3g}, beyond {_LARGEST_UV:g}, where no "
                "fraction is left to find a pixel by; leave uv out, or export the scan again"
            )
        if self.texture_linear is not None and self.texture_linear.size == 0:
            said = f"{self.name}: texture_linear has shape {self.texture_linear.shape}, which holds no pixel"
            raise ScanError(f"{said}; leave it out (None) for a scan without a texture")
        colors = {"texture": self.texture_linear, "vertex colours": self.vertex_color_linear}
        for what, values in colors.items():
            if values is not None and (doubt := linear_doubt(what, values)) and doubt not in self.notes:
                warnings.warn(f"{self.name}: {doubt}", UserWarning, stacklevel=3)
                object.__setattr__(self, "notes", (*self.notes, doubt))

    def _checked(self, field: str, dtype: type, shape: tuple[int | None, ...]):  # type: ignore[no-untyped-def]
        """Convert an array of the scan to its type, and return it."""
        array = np.ascontiguousarray(getattr(self, field))
        fitting = (want in (None, got) for got, want in zip(array.shape, shape, strict=False))
        if array.ndim != len(shape) or not all(fitting):
            wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
            raise ScanError(f"{self.name}: {field} has shape {array.shape}, expected {wanted}")
        array = array.astype(dtype, copy=False)
        if (bad := ~np.isfinite(array)).any():
            raise ScanError(
                f"{self.name}: {field} holds {bad.sum()} values that are NaN or infinite, "
                f"first at {tuple(int(i) for i in np.argwhere(bad)[0])}; repair or re-export the scan"
            )
        object.__setattr__(self, field, array)
        return array

    def inside_out(self) -> Self:
        """Return the scan with every triangle reversed."""
        return replace(self, faces=self.faces[:, ::-1], uv=None if self.uv is None else self.uv[:, ::-1])

    def without_faces(self, gone: BoolArray) -> Self:
        """Return the scan without the faces marked in `gone` (F,); vertices stay."""
        return replace(self, faces=self.faces[~gone], uv=None if self.uv is None else self.uv[~gone])

    def scaled(self, factor: float) -> Self:
        """Return the scan `factor` times as large; a unit of its file is as many mm more."""
        landmarks = None if self.landmarks is None else self.landmarks.scaled(factor)
        mm_per_unit = self.mm_per_unit * factor
        return replace(self, vertices=self.vertices * factor, landmarks=landmarks, mm_per_unit=mm_per_unit)

    @property
    def has_color(self) -> bool:
        """Whether there is a texture with coordinates, or vertex colours, that some picture showed."""
        textured = self.uv is not None and self.texture_linear is not None
        seen = self.color_seen is None or bool(self.color_seen.any())
        return seen and (textured or self.vertex_color_linear is not None)
