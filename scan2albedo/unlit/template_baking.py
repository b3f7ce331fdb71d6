"""`template_texture`, `bake`: colours and fine shape of a mesh on the texture coordinates of another."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Self

import numpy as np
from scipy.ndimage import maximum_filter

from scan2albedo.core import RawScan
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, NDArray, RealArray, dots
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry import mesh, rasterization
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import normalized, vertex_normals, without_unreferenced
from scan2albedo.geometry.oriented_points import SurfaceNoise
from scan2albedo.geometry.rigid import invert_rigid, transform_directions, transform_points
from scan2albedo.geometry.tangents import in_tangent_space, tangent_mesh
from scan2albedo.io.glb import GlbPart
from scan2albedo.sampling.geometry_images import without_covers
from scan2albedo.sampling.texture_lookup import sample_colors, texel_steps
from scan2albedo.unlit.light_removal import GUTTER, UnlitScan
from scan2albedo.unlit.processed_face import REACH_MM

LARGEST_TEXTURE = 8192
"""Texels of a side: pictures with more are not read back."""
FIRST_TILE = 1001
"""UDIM: the tile of coordinates u in [0, 1], v in [0, 1] is 1001, that beside it 1002, that above it 1011."""
LEAST_COSINE = 0.5
"""Surfaces face the same way above this cosine."""
NOISE_RAD = 0.07
"""Averages over neighbours: their noise falls with their number, and so with the square of the angle that
noise turns a face by over an edge; two suffice up to about this angle a pass."""
Fields = Mapping[str, tuple[RealArray, BoolArray]]
"""Values (N, C) of texels by name, and which (N,) of them are known."""


@dataclass(frozen=True)
class TemplateTile:
    """One square of a template's texture, or of any mesh's.

    `number` is that of UDIM, `faces` (F,) which of the template's lie in it; `color_linear` (S, S, 3) is
    known where `seen` (S, S), and filled in from around elsewhere. `normal` (S, S, 3), unit vectors, is the
    shape that the template is too coarse for, in the frames of `geometry.tangents.tangent_mesh`: x along u,
    y along v, z out. It is (0, 0, 1) where the template's own shape is all that is known. Both are float32,
    or, with more than 4096 texels a side, float16, which halves their memory. So are `maps` (S, S) by name.
    """

    number: int
    faces: BoolArray
    color_linear: RealArray
    seen: BoolArray
    normal: RealArray
    maps: Mapping[str, RealArray] = field(default_factory=dict)
    hair: RealArray | None = None
    """(S, S, 4): hair as it was lit, linear, and how surely a texel is hair; None where there is none."""


@dataclass(frozen=True)
class TemplateTexture:
    """A template as it was fitted, with its own texture coordinates and one picture a tile, `tiles`.

    `vertices` (T, 3) are in mm in the model's frame, in the template's order; `faces` (F, 3), `uv` (F, 3, 2).
    """

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray
    tiles: tuple[TemplateTile, ...] = ()
    parts: tuple[GlbPart, ...] = ()
    """Eyes and mouth behind it."""
    cut_mm: FloatArray | None = None
    """(T,): how far inside an opening, behind which these are, a vertex lies; below 0 where it is skin."""
    landmarks: IntArray | None = None
    """(68,): the vertices nearest to these, which `parts` follow."""

    @classmethod
    def of(cls, fitted: FittedFace) -> Self:
        """Return the template of a fitted face without pictures; `ApplicationError` where it has none."""
        model, vertices = fitted.model, fitted.template_vertices
        if vertices is None or model.template_faces is None or model.template_uv is None:
            raise ApplicationError(
                f"{model.name}: the model has no template with texture coordinates; make it from a mesh that "
                "has them (AnnotatedFaceModel.from_file)"
            )
        return cls(vertices, model.template_faces, model.template_uv)


def template_texture(
    scan: RawScan, fitted: FittedFace, size: int = 1024, unlit: UnlitScan | None = None
) -> TemplateTexture:
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
    unlit : UnlitScan, optional
        Whose hair is laid on the tiles, too.
    """
    require_type(scan, RawScan, "template_texture: scan", "load_scan(path) returns one")
    require_type(fitted, FittedFace, "template_texture: fitted", "fit(scan, model, pose) returns one")
    blank = TemplateTexture.of(fitted)
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours to lay on a template")
    return painted(blank, size, Appearance(fitted, scan, unlit))


class Appearance:
    """Colour and fine normals of a scan, at places (N, 3) on a surface in the frame of the `fitted` face."""

    def __init__(self, fitted: FittedFace, scan: RawScan, unlit: UnlitScan | None = None) -> None:
        self._shown, self._hair = without_covers(fitted, scan), None
        if unlit is not None and unlit.hair is not None and unlit.original is not None:
            self._hair = without_covers(fitted, unlit.original), unlit.hair[..., None]
        self._scan_from_model = invert_rigid(fitted.model_from_scan)
        self._shape = FineShape(fitted, self._shown)

    def __call__(
        self, place: FloatArray, outward: FloatArray, tangents: FloatArray, steps: FloatArray
    ) -> Fields:
        """Return colour and normals there; arguments as `painted` gives them."""
        there = (
            transform_points(self._scan_from_model, place),
            transform_directions(self._scan_from_model, outward),
            np.einsum("ij,njk->nik", self._scan_from_model[:3, :3], steps),
        )
        found = sample_colors(self._shown, *there)
        fine = tangent_normals(self._shape.normals(place), outward, tangents)
        fields: dict[str, tuple[RealArray, BoolArray]] = {
            "color": (found.color_linear, found.seen),
            "normal": fine,
        }
        if self._hair is not None and found.pixel is not None:
            original, share = self._hair
            hair = np.column_stack([found.color_linear, rasterization.bilinear(share, found.pixel)])
            hair[:, 3] *= found.seen
            if (some := hair[:, 3] > 1 / 512).any():  # of 8 bits
                hair[some, :3] = sample_colors(original, *(each[some] for each in there)).color_linear
            fields["hair"] = (hair, np.ones(len(hair), bool))
        return fields


def bake(
    source: RawScan, target: RawScan, size: int = 1024, fits: tuple[FittedFace, FittedFace] | None = None
) -> TemplateTexture:
    """Return a mesh's colours, and its fine shape, on the texture coordinates of another one, in its frame.

    Each texel of `target` gets what is nearest to it on `source` and faces its way. Raises `ApplicationError`
    when the source has no colour or the target no texture coordinates, ValueError for another size than 8 to
    8192.

    Parameters
    ----------
    source, target : RawScan
        In one frame, mm, unless `fits` are given.
    size : int
        Texels of a side.
    fits : (FittedFace, FittedFace), optional
        Of source and target, by one model and preset: each texel then gets the colour of the same place of
        the face, whatever the pose and the person; up to 4 mm beside the face, and without normals.
    """
    if not source.has_color:
        raise ApplicationError(f"{source.name}: the mesh has no colours to bake; is its texture beside it?")
    if target.uv is None:
        raise ApplicationError(f"{target.name}: the mesh has no texture coordinates to bake on; unwrap it")
    surface, *faces = [_Surface(one.vertices, one.faces) for one in (source, *(fits or ()))]

    def look(place: FloatArray, outward: FloatArray, tangents: FloatArray, steps: FloatArray) -> Fields:
        if fits is None:
            found = sample_colors(source, place, outward, steps, reach_mm=math.inf)
            fine = tangent_normals(surface.normals_at(place, math.inf), outward, tangents)
            return {"color": (found.color_linear, found.seen), "normal": fine}
        on_source, on_target = fits
        model_from_target, back = on_target.model_from_scan, invert_rigid(on_source.model_from_scan)
        there, normal, close = faces[1].carried(transform_points(model_from_target, place), faces[0])
        turned = np.einsum("ij,njk->nik", (back @ model_from_target)[:3, :3], steps)
        there, normal = transform_points(back, there), transform_directions(back, normal)
        found = sample_colors(source, there, normal, turned)
        flat = np.tile((0.0, 0.0, 1.0), (len(place), 1))
        return {"color": (found.color_linear, found.seen & close), "normal": (flat, close)}

    return painted(TemplateTexture(target.vertices, target.faces, target.uv), size, look)


def painted(blank: TemplateTexture, size: int, look: Callable[..., Fields]) -> TemplateTexture:
    """Return a mesh with tiles of `size` texels a side, filled with what `look` finds.

    `look` is called with places (N, 3) of texels on the mesh, unit normals (N, 3), tangents (N, 4), see
    `tangent_mesh`, and the steps (N, 3, 2) to the next texels, see `sample_colors`. Its fields "color" and
    "normal" become those of a tile, others `maps`; each is filled in from around where it is not known.
    """
    if not isinstance(size, Integral) or not 8 <= size <= LARGEST_TEXTURE:
        raise ValueError(f"size is {size!r}, expected a whole number of texels from 8 to {LARGEST_TEXTURE}")
    vertices, faces, uv = blank.vertices, blank.faces, blank.uv
    numbers, normals, tiles = tile_numbers(uv), vertex_normals(vertices, faces), list[TemplateTile]()
    rows = max(LARGEST_TEXTURE**2 // 256 // size, 1)
    bands = [slice(top, min(top + rows, size)) for top in range(0, size, rows)]  # of 2^18 texels each
    for number in np.unique(numbers[numbers > 0]).tolist():
        chosen = numbers == number
        up, across = divmod(number - FIRST_TILE, 10)
        frames = tangent_mesh(vertices, faces[chosen], uv[chosen], normals)
        split = frames.split
        points = vertices[split.vertex]
        pixels = rasterization.pixels_from_uv(split.uv - [across, up], (size, size))
        steps = texel_steps(points, split.uv, split.faces, (size, size))
        fields, known = dict[str, RealArray](), dict[str, BoolArray]()
        inside = np.zeros((size, size), bool)
        for band in bands:
            below = pixels - [0, band.start]
            raster = rasterization.rasterize(below, np.zeros(len(below)), split.faces, inside[band].shape)
            inside[band] = there = raster.covered
            if not there.any():
                continue
            place, outward, tangents = (
                rasterization.interpolate(raster, split.faces, values)[there]
                for values in (points, frames.normals, frames.tangents)
            )
            found = look(place, normalized(outward), tangents, steps[raster.face[there]])
            for name, (values, sure) in found.items():
                if name not in fields:
                    kind = np.float32 if size <= 4096 else np.float16
                    fields[name] = np.zeros((size, size, values.shape[1]), kind)
                    known[name] = np.zeros((size, size), bool)
                    if name == "normal":
                        fields[name][..., 2] = 1
                fields[name][band][there], known[name][band][there] = values, sure
        # Beside the charts all goes on, for viewers that filter and reduced pictures (mipmaps).
        for name, texels in fields.items():
            rasterization.fill_smoothly(texels, known[name])
            for band in bands:
                wide = slice(max(band.start - 2 * GUTTER, 0), band.stop + 2 * GUTTER)
                gutter = maximum_filter(inside[wide], 2 * GUTTER + 1) & ~inside[wide]
                gutter[: band.start - wide.start] = gutter[band.stop - wide.start :] = False
                if gutter.any():
                    filled = rasterization.filled_from_nearest(texels[wide], inside[wide])
                    texels[wide][gutter] = filled[gutter]
        if not fields:
            continue  # its faces hold no texel's middle
        color, normal, hair = fields.pop("color"), fields.pop("normal"), fields.pop("hair", None)
        for band in bands:
            normal[band] = normalized(normal[band].astype(float))
        maps = {name: texels[..., 0] for name, texels in fields.items()}
        tiles.append(TemplateTile(number, chosen, color, known["color"], normal, maps, hair))
    return replace(blank, tiles=tuple(tiles))


def tile_numbers(uv: FloatArray) -> IntArray:
    """Return (F,) the UDIM number of the tile in which each face lies, by its corners (F, 3, 2); else 0.

    >>> tile_numbers(np.array([[[0.1, 0.1], [1.0, 0.1], [0.1, 1.0]], [[1.2, 0], [1.4, 0], [1.2, 0.3]]]))
    array([1001, 1002])
    """
    middle = np.floor(uv.mean(axis=1)).astype(int)
    inside = (middle >= 0).all(1) & (middle < 10).all(1)
    return np.where(inside, FIRST_TILE + middle[:, 0] + 10 * middle[:, 1], 0)


class FineShape:
    """Normals of a fitted face in the model's frame: those of the scan where it has a surface.

    The scan's normals are the fitted surface's plus what the scan differs by, averaged over neighbours: noise
    averages out, and shape that the fit follows stays sharp. The difference fades at the scan's edges.
    """

    def __init__(self, fitted: FittedFace, scan: RawScan | None) -> None:
        self._fit = _Surface(fitted.vertices, fitted.faces)
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
        close &= dots(own, base) > LEAST_COSINE
        kept = faces[close[faces].all(1)]
        if len(kept) == 0:
            return
        used, faces = without_unreferenced(vertices, kept)
        vertices, base, differs = vertices[used], base[used], (own - base)[used]
        noise_rad = SurfaceNoise.of(vertices, faces).among(np.ones(len(vertices), bool))[0]
        noise_rad /= mesh.median_edge(vertices, faces) or 1.0
        passes = int(np.clip(round((noise_rad / NOISE_RAD) ** 2), 2, 40))
        mean = mesh.neighbour_mean(len(vertices), faces)
        for _ in range(passes):
            differs = mean @ differs
        inner = (~mesh.boundary_vertex_mask(len(vertices), faces)).astype(float)
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
    """A surface (V, 3), (F, 3) with normals (V, 3), of its own or of its faces."""

    def __init__(self, vertices: FloatArray, faces: IntArray, normals: FloatArray | None = None) -> None:
        self.vertices, self._faces = vertices, faces
        self._normals = vertex_normals(vertices, faces) if normals is None else normals
        self._query = surface_query(vertices, faces)
        self._inner = ~mesh.boundary_vertex_mask(len(vertices), faces)

    def normals_at(
        self, points: FloatArray, reach_mm: float = REACH_MM, *, beyond_edges: bool = True
    ) -> tuple[FloatArray, BoolArray]:
        """Return unit normals (N, 3) at closest points, and whether these are within reach."""
        hits = self._query.query(points)
        close = hits.distance <= reach_mm
        if not beyond_edges:
            close &= hits.interpolated(self._inner, self._faces) > np.finfo(np.float32).eps
        return normalized(hits.interpolated(self._normals, self._faces)), close

    def carried(self, points: FloatArray, other: Self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return points (N, 3) as far before another surface of the same faces, its normals (N, 3), and
        whether they are within reach of this one."""
        hits = self._query.query(points)
        own, normal = (normalized(hits.interpolated(s._normals, self._faces)) for s in (self, other))
        before = dots(points - hits.points, own)
        places = hits.interpolated(other.vertices, self._faces) + before[:, None] * normal
        return places, normal, hits.distance <= REACH_MM


def tangent_normals(
    fine: tuple[FloatArray, BoolArray], normals: FloatArray, tangents: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return `FineShape.normals` in frames (N, 3), (N, 4), and which (N,) are not of another part."""
    found = in_tangent_space(fine[0], normals, tangents)
    found = np.where(fine[1][:, None], found, (0.0, 0.0, 1.0))
    return found, found[:, 2] >= LEAST_COSINE


def normal_bytes(normal: RealArray, samples: type = np.uint8) -> NDArray:
    """Return normals (..., 3) in [-1, 1] as glTF's normal maps store them, linear, in such samples.

    >>> normal_bytes(np.array([[0.0, -1.0, 1.0]]))
    array([[128,   0, 255]], dtype=uint8)
    """
    encoded: NDArray = np.empty(normal.shape, samples)
    for row in range(0, len(normal), 256):  # to spare memory
        encoded[row : row + 256] = integers((normal[row : row + 256] + 1) / 2, samples)
    return encoded


def integers(values: RealArray, samples: type = np.uint8) -> NDArray:
    """Return values from 0 to 1, clipped, as integers that count from 0 to the largest of `samples`."""
    return np.round(np.iinfo(samples).max * np.clip(values, 0, 1).astype(float)).astype(samples)
