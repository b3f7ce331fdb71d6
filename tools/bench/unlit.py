"""The scan without its light, at its own texels, beside the chart; and colours on other people's templates.

`scans` are path-traced raw scans with the true albedo on their own coordinates, painted ("traced") and with a
person's skin and hair ("real_skin"): relative RMSE of V = max(R, G, B) after the best single scale, what half
of the texels and 95 in 100 err by at most, and 100 x MSE, on the face and beyond it, of the lit scan, of the
chart's albedo, and of the scan without light on the face alone and everywhere. "rim step" is by how much log
colour of skin steps across the face's rim more than the true albedo does (RMS); "hair" and "not" which part
of what is called hair beyond the face is dark, or skin. `templates` lay a real scan's colours on the texture
coordinates of a mask of 468 vertices and of a head: PSNR of the template's picture against the scan's, same
camera, where the scan shows the template; "close dB" where it is within 0.3 mm of it. The peer (the extra
[peers]) is trimesh's `nricp_amberg`, started from our pose, and some thirty lines that lay the colours on the
mask; it does not take the light off. `normals` are synthetic scans, coarse and fine: mean angle in degrees to
the true normals, where the scan shows it, of a mask of 468 vertices by itself, the fitted surface, the scan,
and the mask's normal map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from worlds.files import DATA, face_data
from worlds.fits import fitted_face
from worlds.light_stage import LightStage

import scan2albedo as s2a
from bench.judging import score
from bench.peers.fit import peer_answer
from bench.runner import Bench, Case, Timed
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import boundary_loops, face_areas, normalized, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, interpolate, pixels_from_uv, rasterize, rasterize_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.geometry.tangents import tangent_mesh
from scan2albedo.io.color import encode_srgb_bytes, srgb_to_linear
from scan2albedo.io.images import read_image_linear
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.synthetic import Scanner, SyntheticTruth, raw_scan
from scan2albedo.unlit.light_removal import scan_on_chart, unlit_scan
from scan2albedo.unlit.template_baking import FineShape, TemplateTexture, template_texture

LEAST_LIGHT = 0.03
"""Texels that got less of the usual light do not count: there is no colour in them."""
DARKEST = 0.01
INSIDE = 0.99
"""Weight of the face above which a texel counts as the face, and below 1 less which it does not."""
SKIN = 0.5
"""Log albedo of skin deviates less than this from the face's; hair is darker by more than twice as much."""
HALF_WIDTH_MM = 110.0
"""Of the pictures."""
PIXELS = 900
SAMPLES = 3
"""Rays along each side of a pixel."""
CLOSE_MM = 0.3
PEERS_TEXELS = 1024
TRUTH_MM = 1.5
"""Texels farther than this from the truth's do not count."""
SCANNERS = ((2.2, 0.2), (1.0, 0.05), (0.8, 0.15))
"""Spacing and noise in mm."""


class Processed:
    """A processed scan beside the true albedo (H, W, 3) of its own texture."""

    def __init__(self, file: Path) -> None:
        self.result = s2a.process(file)
        scan = self.result.scan
        self.shape = scan.texture_linear.shape[:2]
        picture = read_image_linear(file.with_name(f"{file.stem}_albedo.png"))
        self.true = cv2.resize(picture, self.shape[::-1], interpolation=cv2.INTER_LINEAR)
        corners = pixels_from_uv(scan.uv.reshape(-1, 2), self.shape)
        self.index = np.arange(len(corners)).reshape(-1, 3)
        self.raster = rasterize(corners, np.zeros(len(corners)), self.index, self.shape)
        self.vertex_weight = scan_on_chart(scan, self.result.fitted, self.result.albedo.image)[1]
        weight = self.on_texels(self.vertex_weight)[..., 0]
        light = scan.texture_linear.max(-1) / np.maximum(self.true.max(-1), 1e-3)
        usual = np.median(light[weight > INSIDE])
        self.lit = self.raster.covered & (self.true.min(-1) > DARKEST) & (light > LEAST_LIGHT * usual)
        self.inside = self.lit & (weight > INSIDE)
        self.beyond = self.lit & (weight < 1 - INSIDE)

    def on_texels(self, of_vertices: FloatArray) -> FloatArray:
        """Return values of vertices at the texels (H, W, C)."""
        corners = of_vertices[self.result.scan.faces].reshape(3 * len(self.result.scan.faces), -1)
        return interpolate(self.raster, self.index, corners)

    @cached_property
    def log_true(self) -> FloatArray:
        """Log albedo (H, W, 3)."""
        return np.log(np.maximum(self.true, 1e-3))

    @cached_property
    def usual(self) -> FloatArray:
        """Log albedo (3,) of the face."""
        return np.median(self.log_true[self.inside], axis=0)

    @cached_property
    def skin(self) -> BoolArray:
        """Texels (H, W) of skin by their true albedo."""
        return np.abs(self.log_true - self.usual).max(-1) < SKIN

    @cached_property
    def dark(self) -> BoolArray:
        """Texels (H, W) that are as dark as hair."""
        return self.log_true.max(-1) < self.usual.max() - 2 * SKIN

    def rim_step(self, texture: FloatArray) -> float:
        """Return the RMS over the face's rim of the step of log colour of skin across it.

        Medians within 15 mm of a point of the rim: beyond it, and of what lies 10 to 20 mm inside of it.
        """
        fitted = self.result.fitted
        counted = self.lit & self.skin
        place = transform_points(fitted.model_from_scan, self.result.scan.vertices)
        place = self.on_texels(place)[counted]
        value = (np.log(np.maximum(texture, 1e-4)) - self.log_true)[counted]
        rim = max(boundary_loops(fitted.faces), key=len)
        inner = np.ones((len(fitted.vertices), 1))
        inner[rim] = 0
        hits = ClosestPointQuery(fitted.vertices, fitted.faces).query(place)
        off = cKDTree(fitted.vertices[rim]).query(place)[0]
        out = (hits.interpolated(inner, fitted.faces)[:, 0] < 0.02) & (off < 10)
        inside = ~out & (hits.distance < 3) & (off > 10) & (off < 20)
        trees = [cKDTree(place[part]) for part in (inside, out)]
        steps = []
        for point in fitted.vertices[rim[:: max(1, len(rim) // 60)]]:
            near = [tree.query_ball_point(point, reach) for tree, reach in zip(trees, (20, 15), strict=True)]
            if min(map(len, near)) > 30:
                before, after = (
                    np.median(value[part][at], axis=0) for part, at in zip((inside, out), near, strict=True)
                )
                steps.append(after - before)
        return float(np.sqrt(np.mean(np.square(steps)))) if steps else float("nan")


@dataclass(frozen=True)
class Unlit:
    """A texture (H, W, 3) and what is hair on it, or texels (N, 3) of a chart and their true albedo."""

    texture: FloatArray
    hair: FloatArray | None = None
    wanted: FloatArray | None = None


def without_light(scene: Processed, reach: str) -> Unlit:
    found = unlit_scan(scene.result.scan, scene.result.fitted, scene.result.albedo, reach)
    return Unlit(found.scan.texture_linear, found.hair)


def chart(scene: Processed) -> Unlit:
    """Return the chart's albedo at its own texels, on the same part of the face."""
    scan, fitted, estimate = scene.result.scan, scene.result.fitted, scene.result.albedo
    image = estimate.image
    points = transform_points(invert_rigid(fitted.model_from_scan), image.position[image.mask])
    hits = ClosestPointQuery(scan.vertices, scan.faces).query(points)
    uv = np.einsum("nk,nkc->nc", hits.barycentric, scan.uv[hits.face])
    wanted = bilinear(scene.true, pixels_from_uv(uv, scene.shape))
    weight = np.einsum("nk,nk->n", hits.barycentric, scene.vertex_weight.reshape(-1)[scan.faces[hits.face]])
    light = image.texture_linear[image.mask].max(-1) / np.maximum(wanted.max(-1), 1e-3)
    counted = (weight > INSIDE) & image.seen[image.mask] & (wanted.min(-1) > DARKEST)
    counted &= light > LEAST_LIGHT * np.median(light[counted])
    return Unlit(estimate.albedo_linear[image.mask][counted], wanted=wanted[counted])


def scans(quick: bool) -> Iterator[Case]:
    for folder, pattern in (("traced", "p*.obj"), ("real_skin", "*.obj")):
        for file in sorted((DATA / folder).glob(pattern))[: 1 if quick else None]:
            yield Case(file.stem, partial(Processed, file), folder)
        if quick:
            return


def of_texels(name: str, found: NDArray[Any], true: NDArray[Any]) -> dict[str, float]:
    of = score(np.asarray(found, float)[None], np.asarray(true, float)[None], np.ones((1, len(true)), bool))
    return {f"{name} %": of.rmse, f"{name} 50": of.half, f"{name} 95": of.most, f"{name} MSE": of.mse}


def unlit_errors(scene: Processed, found: Unlit) -> dict[str, float]:
    if found.wanted is not None:
        return of_texels("face", found.texture, found.wanted)
    row = of_texels("face", found.texture[scene.inside], scene.true[scene.inside])
    row |= of_texels("beyond", found.texture[scene.beyond], scene.true[scene.beyond])
    row["rim step"] = scene.rim_step(found.texture)
    if found.hair is not None:
        for name, part in (("hair %", scene.dark), ("not %", scene.skin)):
            there = scene.beyond & part
            row[name] = float(100 * (found.hair[there] > 0.5).mean()) if there.any() else np.nan
    return row


@dataclass(frozen=True)
class Fitted:
    """A real scan, a template fitted to it, texels along a side, and the scan's vertices in its frame."""

    scan: s2a.RawScan
    fitted: s2a.FittedFace
    texels: int
    placed: FloatArray

    @property
    def picture(self) -> FloatArray:
        """The scan's own picture."""
        texture = self.scan.uv, encode_srgb_bytes(self.scan.texture_linear)
        return drawn(self.placed, self.scan.faces, texture=texture)


@cache
def template(name: str) -> s2a.AnnotatedFaceModel:
    if name == "mask":
        return s2a.AnnotatedFaceModel.from_file(face_data("canonical_face_model.obj"))
    stage = LightStage.load()
    head = stage.shapes["generic_neutral"], stage.faces, stage.corner_uv
    return s2a.AnnotatedFaceModel.from_mesh(*head, control_size=2500, name=name)


@cache
def fitted_template(name: str, texels: int) -> Fitted:
    scan = s2a.load_scan(face_data("james.obj"))
    fitted = fitted_face(scan, template(name))
    return Fitted(scan, fitted, texels, transform_points(fitted.model_from_scan, scan.vertices))


@dataclass(frozen=True)
class Drawn:
    """Pictures of a template, and where they count, by column."""

    shown: dict[str, tuple[FloatArray, BoolArray]]
    seen: float = float("nan")


def drawn(vertices: FloatArray, faces: NDArray[Any], **colors: Any) -> FloatArray:
    """Return a picture (S, S, 3) from the front of a mesh without shading, in bytes of sRGB."""
    view = View((0.0, 0.0, 0.0), HALF_WIDTH_MM)
    picture = render_mesh(vertices, faces, view=view, size=SAMPLES * PIXELS, shaded=False, **colors)
    return cv2.resize(picture.astype(np.float32), (PIXELS, PIXELS), interpolation=cv2.INTER_AREA)


def tile_drawn(painted: TemplateTexture, chosen: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the picture of the first tile's faces that have `chosen` (T,) vertices, and where it counts."""
    tile = painted.tiles[0]
    faces = tile.faces & chosen[painted.faces].all(1)
    mesh = painted.vertices, painted.faces[faces]
    uv = painted.uv[faces]
    unseen = np.repeat(np.where(tile.seen[..., None], 0, 255).astype(np.uint8), 3, axis=2)
    # Black is what lies wholly on the template, and is seen.
    counted = drawn(*mesh, texture=(uv, unseen)).max(-1) == 0
    return drawn(*mesh, texture=(uv, encode_srgb_bytes(tile.color_linear))), counted


def painted_by_us(scene: Fitted) -> Drawn:
    painted = template_texture(scene.scan, scene.fitted, scene.texels)
    distance = ClosestPointQuery(scene.placed, scene.scan.faces).query(painted.vertices).distance
    everything = np.ones(len(distance), bool)
    shown = {"dB": tile_drawn(painted, everything), "close dB": tile_drawn(painted, distance < CLOSE_MM)}
    return Drawn(shown, float(np.mean([tile.seen.mean() for tile in painted.tiles])))


def nricp_and_bake(scene: Fitted) -> Timed:
    painted = template_texture(scene.scan, scene.fitted, PEERS_TEXELS)
    model = scene.fitted.model
    given = {"scan_vertices": scene.placed, "scan_faces": scene.scan.faces, "faces": painted.faces}
    moved = peer_answer("nricp_amberg", given | {"vertices": model.template_of(model.control_vertices)})
    texture = encode_srgb_bytes(scene.scan.texture_linear)
    given |= {"uv": painted.uv, "scan_uv": scene.scan.uv, "texture": texture, "size": np.array(PEERS_TEXELS)}
    baked = peer_answer("bake", given | {"vertices": moved["vertices"]})
    color = srgb_to_linear(baked["color_srgb"] / 255).astype(np.float32)
    tile = replace(painted.tiles[0], color_linear=color)
    other = replace(painted, vertices=moved["vertices"], tiles=(tile,))
    shown = tile_drawn(other, np.ones(len(other.vertices), bool))
    return Timed(Drawn({"dB": shown}), float(moved["cpu_s"] + baked["cpu_s"]))


def likeness(scene: Fitted, found: Drawn) -> dict[str, float]:
    """Return the PSNR of pictures beside that of the scan, in dB, and which part of the texels it shows."""
    row = {"seen %": 100 * found.seen}
    for column, (shown, counted) in found.shown.items():
        row[column] = float(10 * np.log10(255**2 / np.mean((shown - scene.picture)[counted] ** 2)))
    return row


def templates(quick: bool) -> Iterator[Case]:
    for name in ("mask",) if quick else ("mask", "head"):
        for texels in (1024,) if quick else (1024, 2048):
            yield Case(f"{name} {texels}", partial(fitted_template, name, texels), name)


@dataclass(frozen=True)
class Sitting:
    """A scan, its truth, and the mask fitted to it."""

    scan: s2a.RawScan
    truth: SyntheticTruth
    fitted: s2a.FittedFace


def sitting(spacing_mm: float, noise_mm: float, seed: int) -> Sitting:
    scanner = Scanner(spacing_mm=spacing_mm, noise_mm=noise_mm, picture_size=400)
    scan, truth = raw_scan(seed, scanner=scanner)
    return Sitting(scan, truth, fitted_face(scan, template("mask")))


def sittings(quick: bool) -> Iterator[Case]:
    for spacing_mm, noise_mm in SCANNERS[: 1 if quick else None]:
        for seed in range(1 if quick else 2):
            name = f"{spacing_mm} mm, noise {noise_mm} mm, {seed}"
            yield Case(name, partial(sitting, spacing_mm, noise_mm, seed))


@dataclass(frozen=True)
class Texels:
    """Texels that the scan shows: places, the template's and the map's normals (N, 3), area of each (N,)."""

    place: FloatArray
    flat: FloatArray
    mapped: FloatArray
    area: FloatArray

    @classmethod
    def of(cls, painted: TemplateTexture) -> Texels:
        """Return those of a template of one tile."""
        (tile,) = painted.tiles
        own = vertex_normals(painted.vertices, painted.faces)
        frames = tangent_mesh(painted.vertices, painted.faces, painted.uv, own)
        faces = frames.split.faces
        raster = rasterize_uv(frames.split.uv, faces, PEERS_TEXELS)
        known = tile.seen & raster.covered
        place, flat, tangent = (
            interpolate(raster, faces, values)[known]
            for values in (painted.vertices[frames.split.vertex], frames.normals, frames.tangents)
        )
        flat, right = normalized(flat), normalized(tangent[:, :3])
        up = tangent[:, 3:] * np.cross(flat, right)
        x, y, z = tile.normal[known].astype(float).T[..., None]
        area = face_areas(painted.vertices, frames.split.vertex[faces])
        counts = np.bincount(raster.face[known], minlength=len(area))
        share = (area / np.maximum(counts, 1))[raster.face[known]]
        return cls(place, flat, normalized(x * right + y * up + z * flat), share)


def angles_deg(scene: Sitting, painted: TemplateTexture) -> dict[str, float]:
    """Return mean angles to the true normals of template, fit, scan and map."""
    scan, fitted, truth = scene.scan, scene.fitted, scene.truth
    texels = Texels.of(painted)
    truth_from_model = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    inside = truth.image.mask
    in_truth = transform_points(truth_from_model, texels.place)
    gap, nearest = cKDTree(truth.image.position[inside]).query(in_truth)
    true = truth.image.normal[inside][nearest] @ truth_from_model[:3, :3]
    placed = transform_points(fitted.model_from_scan, scan.vertices)
    hits = ClosestPointQuery(placed, scan.faces).query(texels.place)
    found = {
        "mask deg": texels.flat,
        "fit deg": FineShape(fitted, None).normals(texels.place)[0],
        "scan deg": normalized(hits.interpolated(vertex_normals(placed, scan.faces), scan.faces)),
        "map deg": texels.mapped,
    }
    # The truth ends before the template does.
    weight = texels.area * (gap < TRUTH_MM)
    cosines = {name: np.einsum("ij,ij->i", normal, true) for name, normal in found.items()}
    angles = {name: np.degrees(np.arccos(np.clip(cosine, -1, 1))) for name, cosine in cosines.items()}
    return {name: float(np.average(angle, weights=weight)) for name, angle in angles.items()}


BENCHES = {
    "scans": Bench(
        scans,
        methods={
            "unlit, face": partial(without_light, reach="face"),
            "unlit, all": partial(without_light, reach="all"),
            "lit": lambda scene: Unlit(scene.result.scan.texture_linear),
            "chart": chart,
        },
        score=unlit_errors,
    ),
    "templates": Bench(
        templates,
        methods={"scan2albedo": painted_by_us},
        peers={"nricp_amberg and a bake": nricp_and_bake},
        score=likeness,
        slow=("nricp_amberg and a bake",),
        summaries=(),
    ),
    "normals": Bench(
        sittings,
        methods={"scan2albedo": lambda scene: template_texture(scene.scan, scene.fitted, PEERS_TEXELS)},
        score=angles_deg,
    ),
}
