"""`template_texture`: colours and fine shape of an unlit scan on the coordinates of anyone's template."""

from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import maximum_filter

from scan2albedo.applications.light_removal import GUTTER
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry import mesh, rasterization
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import normalized, vertex_normals, without_unreferenced
from scan2albedo.geometry.oriented_points import SurfaceNoise
from scan2albedo.geometry.rigid import invert_rigid, transform_directions, transform_points
from scan2albedo.geometry.tangents import in_tangent_space, tangent_mesh
from scan2albedo.sampling.geometry_images import without_covers
from scan2albedo.sampling.texture_lookup import sample_colors, texel_steps

LARGEST_TEXTURE = 8192
"""Texels of a side: pictures with more are not read back."""
FIRST_TILE = 1001
"""UDIM: the tile of coordinates u in [0, 1], v in [0, 1] is 1001, that beside it 1002, that above it 1011."""
REACH_MM = 4.0
"""What lies farther from a surface has its shape from elsewhere."""
LEAST_COSINE = 0.5
"""Surfaces face the same way above this cosine."""
NOISE_RAD = 0.07
"""Averages over neighbours: their noise falls with their number, and so with the square of the angle that
noise turns a face by over an edge; two suffice up to about this angle a pass."""


@dataclass(frozen=True)
class TemplateTile:
    """One square of a template's texture.

    `number` is that of UDIM, `faces` (F,) which of the template's lie in it; `color_linear` (S, S, 3) is
    known where `seen` (S, S), and filled in from around elsewhere. `normal` (S, S, 3), unit vectors, is the
    shape that the template is too coarse for, in the frames of `geometry.tangents.tangent_mesh`: x along u,
    y along v, z out. It is (0, 0, 1) where the template's own shape is all that is known. Both are float32,
    or, with more than 4096 texels a side, float16, which halves their memory.
    """

    number: int
    faces: BoolArray
    color_linear: NDArray[np.floating]
    seen: BoolArray
    normal: NDArray[np.floating]


@dataclass(frozen=True)
class TemplateTexture:
    """A template as it was fitted, with its own texture coordinates and one picture a tile, `tiles`.

    `vertices` (T, 3) are in mm in the model's frame, in the template's order; `faces` (F, 3), `uv` (F, 3, 2).
    """

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray
    tiles: tuple[TemplateTile, ...]


def template_texture(scan: RawScan, fitted: FittedFace, size: int = 1024) -> TemplateTexture:
    """Return a scan's colours on the texture coordinates of the template that was fitted to it.

    Each texel gets the colour of the scan's point nearest to the template there, averaged over the texel's
    footprint, and its normal, freed from noise. What the scan does not show is filled in from around. Raises
    `ApplicationError` when the scan has no colour, or the model no template with texture coordinates;
    `ValueError` for another size than 8 to 8192.

    Parameters
    ----------
    scan : RawScan
        With colour: that which was fitted, or the same without its light (`unlit_scan`).
    fitted : FittedFace
        Of a model made from a template with texture coordinates (`AnnotatedFaceModel.from_file`).
    size : int
        Texels of a tile's side.
    """
    require_type(scan, RawScan, "template_texture: scan", "load_scan(path) returns one")
    require_type(fitted, FittedFace, "template_texture: fitted", "fit(scan, model, pose) returns one")
    vertices, faces, uv = fitted.template_vertices, fitted.model.template_faces, fitted.model.template_uv
    if vertices is None or faces is None or uv is None:
        raise ApplicationError(
            f"{fitted.model.name}: the model has no template with texture coordinates; make it from a mesh "
            "that has them (AnnotatedFaceModel.from_file)"
        )
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours to lay on a template")
    if not isinstance(size, Integral) or not 8 <= size <= LARGEST_TEXTURE:
        raise ValueError(f"size is {size!r}, expected a whole number of texels from 8 to {LARGEST_TEXTURE}")
    numbers, shown = tile_numbers(uv), without_covers(fitted, scan)
    shape, tiles = FineShape(fitted, shown), []
    scan_from_model, template_normals = invert_rigid(fitted.model_from_scan), vertex_normals(vertices, faces)
    rows = max(LARGEST_TEXTURE**2 // 256 // size, 1)
    bands = [slice(top, min(top + rows, size)) for top in range(0, size, rows)]  # of 2^18 texels each
    for number in np.unique(numbers[numbers > 0]).tolist():
        chosen = numbers == number
        up, across = divmod(number - FIRST_TILE, 10)
        frames = tangent_mesh(vertices, faces[chosen], uv[chosen], template_normals)
        split = frames.split
        points = vertices[split.vertex]
        pixels = rasterization.pixels_from_uv(split.uv - [across, up], (size, size))
        steps = texel_steps(points, split.uv, split.faces, (size, size))
        color, normal = np.zeros((2, size, size, 3), np.float32 if size <= 4096 else np.float16)
        normal[..., 2] = 1
        seen, stands, inside = np.zeros((3, size, size), bool)
        for band in bands:
            below = pixels - [0, band.start]
            raster = rasterization.rasterize(below, np.zeros(len(below)), split.faces, color[band].shape[:2])
            inside[band] = there = raster.covered
            if not there.any():
                continue
            place, outward, tangents = (
                rasterization.interpolate(raster, split.faces, values)[there]
                for values in (points, frames.normals, frames.tangents)
            )
            found = sample_colors(
                shown,
                transform_points(scan_from_model, place),
                transform_directions(scan_from_model, normalized(outward)),
                np.einsum("ij,njk->nik", scan_from_model[:3, :3], steps[raster.face[there]]),
            )
            color[band][there], seen[band][there] = found.color_linear, found.seen
            fine = shape.normals(place)
            normal[band][there], stands[band][there] = tangent_normals(fine, outward, tangents)
        # Beside the charts normals and colours go on, for viewers that filter and reduced pictures (mipmaps).
        for field, known in ((normal, stands), (color, seen)):
            rasterization.fill_smoothly(field, known)
            for band in bands:
                wide = slice(max(band.start - 2 * GUTTER, 0), band.stop + 2 * GUTTER)
                beside = maximum_filter(inside[wide], 2 * GUTTER + 1) & ~inside[wide]
                beside[: band.start - wide.start] = beside[band.stop - wide.start :] = False
                if beside.any():
                    field[wide][beside] = rasterization.filled_from_nearest(field[wide], inside[wide])[beside]
        for band in bands:
            normal[band] = normalized(normal[band].astype(np.float64))
        tiles.append(TemplateTile(number, chosen, color, seen, normal))
    return TemplateTexture(vertices, faces, uv, tuple(tiles))


def tile_numbers(uv: FloatArray) -> IntArray:
    """Return (F,) the UDIM number of the tile in which each face lies, by its corners (F, 3, 2); else 0.

    >>> tile_numbers(np.array([[[0.1, 0.1], [1.0, 0.1], [0.1, 1.0]], [[1.2, 0], [1.4, 0], [1.2, 0.3]]]))
    array([1001, 1002])
    """
    middle = np.floor(uv.mean(axis=1)).astype(np.int64)
    inside = (middle >= 0).all(1) & (middle < 10).all(1)
    return np.where(inside, FIRST_TILE + middle[:, 0] + 10 * middle[:, 1], 0)


class FineShape:
    """Normals of a fitted face in the model's frame: those of the scan where it has a surface.

    The scan's normals are the fitted surface's plus what the scan differs by, averaged over neighbours: noise
    averages out, and shape that the fit follows stays sharp. The difference fades at the scan's edges.
    """

    def __init__(self, fitted: FittedFace, scan: RawScan | None) -> None:
        self._fit = _Surface(fitted.vertices, fitted.faces, vertex_normals(fitted.vertices, fitted.faces))
        self._scan: _Surface | None = None
        if scan is None:
            return
        # Of the scan what lies at the fitted surface and faces its way.
        vertices, faces = transform_points(fitted.model_from_scan, scan.vertices), scan.faces
        low, high = self._fit.vertices.min(0) - REACH_MM, self._fit.vertices.max(0) + REACH_MM
        boxed = np.flatnonzero(((vertices >= low) & (vertices <= high)).all(1))
        own, close = vertex_normals(vertices, faces), np.zeros(len(vertices), bool)
        base = np.zeros_like(own)
        base[boxed], close[boxed] = self._fit.normals_at(vertices[boxed])
        close &= np.einsum("ij,ij->i", own, base) > LEAST_COSINE
        kept = faces[close[faces].all(1)]
        if len(kept) == 0:
            return
        used, faces = without_unreferenced(vertices, kept)
        vertices, base, differs = vertices[used], base[used], (own - base)[used]
        noise_rad = SurfaceNoise.of(vertices, faces).among(np.ones(len(vertices), bool))[0]
        noise_rad /= max(mesh.usual_edge(vertices, faces), 1e-9)
        passes = int(np.clip(round((noise_rad / NOISE_RAD) ** 2), 2, 40))
        around = mesh.adjacency(len(vertices), faces) + sparse.identity(len(vertices), format="csr")
        mean = sparse.diags(1 / np.asarray(around.sum(1)).ravel()) @ around
        for _ in range(passes):
            differs = mean @ differs
        inner = (~mesh.boundary_vertex_mask(len(vertices), faces)).astype(np.float64)
        share = inner
        for _ in range(8):  # the scan's own shape fades at its edges, about three edges of its faces wide
            share = inner * (mean @ share)
        self._scan = _Surface(vertices, faces, normalized(base + share[:, None] * differs))

    def normals(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return unit normals (N, 3) at points (N, 3), and whether (N,) there is a surface."""
        normal, known = self._fit.normals_at(points)
        if self._scan is not None:
            own, close = self._scan.normals_at(points, beyond_edges=False)
            normal, known = np.where(close[:, None], own, normal), known | close
        return normal, known


class _Surface:
    """A surface (V, 3), (F, 3) with normals (V, 3) of its own."""

    def __init__(self, vertices: FloatArray, faces: IntArray, normals: FloatArray) -> None:
        self.vertices, self._faces, self._normals = vertices, faces, normals
        self._query = surface_query(vertices, faces)
        self._inner = ~mesh.boundary_vertex_mask(len(vertices), faces)

    def normals_at(self, points: FloatArray, *, beyond_edges: bool = True) -> tuple[FloatArray, BoolArray]:
        """Return unit normals (N, 3) at closest points, and whether these are within reach."""
        hits = self._query.query(points)
        corners = self._faces[hits.face]
        close = hits.distance <= REACH_MM
        if not beyond_edges:
            close &= np.einsum("nk,nk->n", hits.barycentric, self._inner[corners]) > 1e-6
        return normalized(np.einsum("nk,nkc->nc", hits.barycentric, self._normals[corners])), close


def tangent_normals(
    fine: tuple[FloatArray, BoolArray], normals: FloatArray, tangents: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return `FineShape.normals` in frames (N, 3), (N, 4), and which (N,) are not of another part."""
    found = in_tangent_space(fine[0], normals, tangents)
    found = np.where(fine[1][:, None], found, (0.0, 0.0, 1.0))
    return found, found[:, 2] >= LEAST_COSINE


def normal_bytes(normal: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return normals (..., 3) in [-1, 1] as glTF's normal maps store them, 8 bits, linear.

    >>> normal_bytes(np.array([[0.0, -1.0, 1.0]]))
    array([[128,   0, 255]], dtype=uint8)
    """
    encoded = np.empty(normal.shape, np.uint8)
    for row in range(0, len(normal), 256):  # to spare memory
        encoded[row : row + 256] = np.round(127.5 * (np.clip(normal[row : row + 256], -1, 1) + 1))
    return encoded
