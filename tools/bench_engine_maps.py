"""Engine maps in a path tracer beside the raw scan's photographs: PSNR before and after each map joins.

    python tools/bench_engine_maps.py [SCAN ...] [--texels 384] [--size 200] [--paths 36] [--pictures FOLDER]

Mitsuba renders the fitted face from the front with `engine_maps` on the model's chart, as its principled
material, under the light that was estimated. The reference is the raw scan, its own lit texture shining by
itself, in the same camera. PSNR is of sRGB after the one exposure of all channels that suits best, where the
fitted face covers the scan within 4 mm. One line a scan, columns in this order:

texture    the lit texture on the fitted face, shining by itself: what shape and texels cost
constant   one colour, with all maps; lit: the lit texture, lit again, with all maps
lambert    the albedo, matte, without Mitsuba's Burley diffuse
albedo     the albedo in the principled material, matte; then what joins it, one after another:
+normals, +displaced, +roughness (and a gloss of F0 .04), +specular, +cavity (gloss times 2 c, at most 1)
own        the albedo, matte, with the displaced surface's own normals in place of the normal map
open, +occlusion     matte with normals, where nothing hides the soft light, and times the occlusion map,
           as engines without rays shade it
true, true+  the scan's true albedo, matte and smooth, and with all maps

A second line, `relit:SCAN`, has the albedo's PSNR beside the true head of the same matte albedo in another
light, a lamp at the side and an even sky: lit, constant, albedo, +normals, +displaced, own, true.

Needs Mitsuba (`llvm_ad_rgb`, so DRJIT_LIBLLVM_PATH) and scans that are not part of the repository.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from bench.judging import ScanTruth
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import minimize_scalar
from worlds.files import DATA
from worlds.lamps import environment_map
from worlds.path_tracer import textured_mesh

import scan2albedo as s2a
from scan2albedo.applications import engine_maps, unlit_scan
from scan2albedo.applications.template_baking import REACH_MM, Appearance, TemplateTexture, painted
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.lights import EnvironmentLight, PointLight
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.geometry.tangents import split_at_seams, tangent_mesh
from scan2albedo.io.color import encode_srgb_bytes, linear_to_srgb
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.rendering.pictures import auto_exposure

SCANS = ("james.obj", "fran.obj", "traced/p*.obj", "real_skin/d_*.obj")
CAMERA_MM, FAR_MM = 1000.0, 20000.0
"""From the face to the camera, and to lamps that are infinitely far."""
LEAST_RADIUS_DEG = 0.5
"""Of lamps that are points: Mitsuba's then have an outline like others."""
QUARTERED = 2
"""Times that the fitted face's triangles are divided before they are displaced: edges of some 0.4 mm."""
PATH = {"type": "path", "max_depth": 5, "rr_depth": 100}
SHINING, LAMPS_ALONE = {"type": "path", "max_depth": 1}, {"type": "path", "max_depth": 2}
RELIT = PointLight(-1.0, 0.5, np.inf, 3.0, radius_deg=6.0)
COLUMNS = (
    *("texture", "constant", "lit", "lambert", "albedo", "+normals", "+displaced", "+roughness", "+specular"),
    *("+cavity", "own", "open", "+occlusion", "true", "true+"),
)
RELIT_COLUMNS = ("lit", "constant", "albedo", "+normals", "+displaced", "own", "true")
Mesh = tuple[FloatArray, FloatArray, IntArray, FloatArray]
"""Vertices, normals, faces, places in the texture, one for each vertex."""


class Studio:
    """An orthographic camera before a face (V, 3) that looks along +z, in Mitsuba."""

    def __init__(self, vertices: FloatArray, size: int, paths: int) -> None:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(1)
        self.mi = mitsuba
        low, high = vertices.min(0), vertices.max(0)
        middle, half = (low + high) / 2, float((high - low)[:2].max() / 2)
        look = {"origin": [*middle[:2], high[2] + CAMERA_MM], "target": [*middle[:2], 0.0], "up": [0, 1, 0]}
        transform = mitsuba.ScalarTransform4f
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
        self._sensor = {
            "type": "orthographic",
            "near_clip": 1.0,
            "far_clip": 1e5,
            "to_world": transform().look_at(**look) @ transform().scale([half, half, 1]),
            "film": film | {"pixel_format": "rgb", "component_format": "float32"},
            "sampler": {"type": "multijitter", "sample_count": paths},
        }
        mitsuba.register_integrator("open_sky", lambda properties: open_sky(mitsuba)(properties))

    def picture(self, integrator: dict[str, Any], **things: Any) -> FloatArray:
        """Return (S, S, C) what the camera sees."""
        scene = {"type": "scene", "sensor": self._sensor, "integrator": integrator, **things}
        return np.array(self.mi.render(self.mi.load_dict(scene)), np.float64)

    def bitmap(self, values: NDArray) -> dict[str, Any]:
        """Return a linear texture (H, W) or (H, W, 3)."""
        data = np.ascontiguousarray(np.atleast_3d(values), np.float32)
        return {"type": "bitmap", "data": self.mi.TensorXf(data), "raw": True}

    def mesh(self, shape: Mesh, **looks: dict[str, Any]) -> Any:
        """Return a shape with a material `bsdf`, and perhaps an `emitter`."""
        vertices, normals, faces, uv = shape
        properties = self.mi.Properties()
        for name, look in looks.items():
            properties[name] = self.mi.load_dict(look)
        return textured_mesh(self.mi, vertices, normals, faces, uv * [1, -1] + [0, 1], properties)

    def shining(self, shape: Mesh, texture: NDArray) -> FloatArray:
        """Return the picture (S, S, 3) of a shape that shines as bright as its texture."""
        black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
        emitter = {"type": "area", "radiance": self.bitmap(texture)}
        return self.picture(SHINING, face=self.mesh(shape, bsdf=black, emitter=emitter))

    def depth_and_cover(self, shape: Mesh) -> tuple[FloatArray, BoolArray]:
        """Return (S, S) the height z of what is seen, and where it fills the pixel."""
        place = self.picture(
            {"type": "aov", "aovs": "place:position"}, face=self.mesh(shape, bsdf={"type": "diffuse"})
        )
        return place[..., 2], self.shining(shape, np.ones((2, 2)))[..., 0] > 0.999

    def light(
        self, lamps: tuple[PointLight, ...], environment: EnvironmentLight | None
    ) -> dict[str, dict[str, Any]]:
        """Return a light as Mitsuba's emitters.

        A disc of angular radius r gives the irradiance pi E at the origin with radiance E / sin^2 r. The sky
        keeps what is below 0 where its harmonics ring: rendering is linear.
        """
        plugins, transform = dict[str, dict[str, Any]](), self.mi.ScalarTransform4f
        for number, lamp in enumerate(lamps):
            distance, radius = (
                min(lamp.distance_mm, FAR_MM),
                np.deg2rad(max(lamp.radius_deg, LEAST_RADIUS_DEG)),
            )
            radiance = lamp.intensity / np.sin(radius) ** 2 * np.array(lamp.color_linear)
            look = {"origin": (distance * lamp.direction).tolist(), "target": [0, 0, 0], "up": [0, 1, 0]}
            plugins[f"lamp{number}"] = {
                "type": "disk",
                "to_world": transform().look_at(**look) @ transform().scale([distance * np.tan(radius)] * 3),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}},
            }
        if environment is not None:
            sky = environment_map(lambda toward: radiance_of(environment, toward)).astype(np.float32)
            # Smooth light is best sampled by the material alone; with no lamp to pick, a dark one is picked.
            plugins["sky"] = {"type": "envmap", "bitmap": self.mi.Bitmap(sky), "sampling_weight": 0.0}
            if not lamps:
                dark = {"type": "rgb", "value": 0.0}
                plugins["dark"] = {"type": "point", "position": [0, 0, 1e4], "intensity": dark}
        return plugins


def radiance_of(environment: EnvironmentLight, toward: FloatArray) -> FloatArray:
    """Return (N, 3) the radiance from unit directions (N, 3).

    >>> radiance_of(EnvironmentLight.constant(), np.eye(3)).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    values = harmonics(toward, 2)
    return np.asarray(values / values[:, :1] @ environment.coefficients)


def open_sky(mi: Any) -> Any:
    """Return an integrator's class: light of the environment that nothing hides, and no bounces."""
    import drjit

    class OpenSky(mi.SamplingIntegrator):  # type: ignore[misc, name-defined]
        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[float]]:
            hit = scene.ray_intersect(ray, active)
            drawn, weight = hit.bsdf(ray).sample(
                mi.BSDFContext(), hit, sampler.next_1d(active), sampler.next_2d(active), active
            )
            away = drjit.zeros(mi.SurfaceInteraction3f, drjit.width(hit))
            away.wi = -hit.to_world(drawn.wo)
            seen = active & hit.is_valid()
            return drjit.select(seen, weight * scene.environment().eval(away, seen), 0.0), seen, []

    return OpenSky


class Face:
    """A baked face as Mitsuba's shapes: flat, displaced, and displaced with its own normals."""

    def __init__(self, studio: Studio, baked: TemplateTexture) -> None:
        (self.tile,), self._studio = baked.tiles, studio
        normals = vertex_normals(baked.vertices, baked.faces)
        frames = tangent_mesh(baked.vertices, baked.faces, baked.uv, normals)
        if (frames.tangents[:, 3] < 0).any():
            raise ValueError("the chart is mirrored; Mitsuba's frames are not")
        split = frames.split
        self.flat: Mesh = baked.vertices[split.vertex], normalized(frames.normals), split.faces, split.uv
        fine, faces = np.concatenate([*self.flat[:2], split.uv], 1), split.faces
        for _ in range(QUARTERED):
            fine, faces = trimesh.remesh.subdivide(fine, faces)
        outward, uv = normalized(fine[:, 3:6]), fine[:, 6:]
        high = bilinear(
            self.tile.maps["displacement_mm"][..., None], pixels_from_uv(uv, self.tile.seen.shape)
        )
        moved = fine[:, :3] + high * outward
        self.displaced: Mesh = moved, outward, faces, uv
        self.own: Mesh = moved, vertex_normals(moved, faces), faces, uv

    def material(
        self, color: NDArray, maps: str = "", *, shape: Mesh | None = None, lambert: bool = False
    ) -> Any:
        """Return the shape with a colour (H, W, 3) and the maps whose names are in `maps`."""
        bitmap, tile, names = self._studio.bitmap, self.tile, maps.split()
        base = {"type": "principled", "base_color": bitmap(color), "specular": 0.0}
        bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": bitmap(color)} if lambert else base
        if "roughness" in names:
            base["roughness"] = bitmap(tile.maps["roughness"])
            weight = tile.maps["specular"] if "specular" in names else np.ones(tile.seen.shape)
            if "cavity" in names:
                weight = weight * np.minimum(2 * tile.maps["cavity"], 1)
            # KHR_materials_specular: the factor weighs the lobe of a dielectric of F0 .04.
            glossy = base | {"specular": 0.5}
            bsdf = {"type": "blendbsdf", "weight": bitmap(np.clip(weight, 0, 1)), "a": base, "b": glossy}
        if "normals" in names:
            # Mitsuba darkens what leans away from the surface (shadowing); engines do not.
            leaning = {"normalmap": bitmap(0.5 + 0.5 * tile.normal), "use_shadowing_function": False}
            bsdf = {"type": "normalmap", **leaning, "inner": bsdf}
        return self._studio.mesh(shape or self.flat, bsdf=bsdf)


def likeness(linear: FloatArray, reference: FloatArray, counted: BoolArray) -> tuple[float, float]:
    """Return the PSNR of sRGB (H, W, 3) after the best exposure of all channels, in dB, and that.

    >>> grey = np.full((2, 2, 3), 0.2)
    >>> round(likeness(3 * grey, grey, np.ones((2, 2), bool))[1], 4)
    0.3333
    """
    ours, true = linear[counted], reference[counted]
    start, shown = float((ours * true).sum() / max((ours**2).sum(), 1e-12)), _srgb(true)
    search = minimize_scalar(
        lambda log: np.mean((_srgb(start * np.exp(log) * ours) - shown) ** 2), bounds=(-1.5, 1.5)
    )
    return float(-10 * np.log10(max(search.fun, 1e-12))), start * float(np.exp(search.x))


def _srgb(linear: FloatArray) -> FloatArray:
    return np.asarray(linear_to_srgb(np.clip(linear, 0, 1)))


Pictures = dict[str, tuple[FloatArray, FloatArray, BoolArray]]
"""By column: picture, reference and what counts."""


def pictures_of(file: Path, texels: int, size: int, paths: int) -> tuple[Pictures, Pictures]:
    """Return the pictures of a scan in its own light, and, where its albedo is known, in another one."""
    result = s2a.process(file)
    scan, fitted, estimate = result.scan, result.fitted, result.albedo
    assert fitted is not None
    assert estimate is not None
    assert scan.texture_linear is not None
    assert scan.uv is not None
    baked = engine_maps(unlit_scan(scan, fitted, estimate, "all").scan, fitted, estimate, "chart", texels)
    blank = replace(baked, tiles=())

    def color_of(texture: NDArray) -> NDArray:
        look = Appearance(fitted, replace(scan, texture_linear=texture))
        return np.asarray(painted(blank, texels, look).tiles[0].color_linear)

    studio = Studio(fitted.vertices, size, paths)
    face = Face(studio, baked)
    tile, lit = face.tile, color_of(scan.texture_linear)
    albedo = np.asarray(tile.color_linear)
    constant = np.broadcast_to(np.median(albedo[tile.seen], axis=0), albedo.shape)
    depth, cover = studio.depth_and_cover(face.flat)
    cover &= studio.shining(face.flat, tile.seen)[..., 0] > 0.999

    def seen_at(shape: Mesh) -> BoolArray:
        other, covered = studio.depth_and_cover(shape)
        return cover & covered & (np.abs(other - depth) < REACH_MM)

    def split(vertices: FloatArray, faces: IntArray, uv: FloatArray) -> Mesh:
        parts, normals = split_at_seams(faces, uv), vertex_normals(vertices, faces)
        return vertices[parts.vertex], normals[parts.vertex], parts.faces, parts.uv

    raw = transform_points(fitted.model_from_scan, scan.vertices)
    shape = split(raw, scan.faces, in_first_period(scan.uv, scan.texture_linear.shape))
    photographs, counted = studio.shining(shape, scan.texture_linear), seen_at(shape)
    environment = estimate.environment or EnvironmentLight.constant()
    light, lamps = studio.light(estimate.lights, environment), studio.light(estimate.lights, None)

    def traced(*of: Any, **options: Any) -> FloatArray:
        return studio.picture(PATH, face=face.material(*of, **options), **light)

    gloss, high = "normals roughness specular", face.displaced
    under_sky = face.material(albedo, "normals")
    open_light = studio.picture({"type": "open_sky"}, face=under_sky, **studio.light((), environment))
    of_lamps = studio.picture(LAMPS_ALONE, face=under_sky, **lamps) if lamps else 0.0
    occlusion = studio.shining(face.flat, tile.maps["occlusion"])[..., :1]
    own = {
        "texture": studio.shining(face.flat, lit),
        "constant": traced(constant, gloss, shape=high),
        "lit": traced(lit, gloss, shape=high),
        "lambert": traced(albedo, lambert=True),
        "albedo": traced(albedo),
        "+normals": traced(albedo, "normals"),
        "+displaced": traced(albedo, "normals", shape=high),
        "+roughness": traced(albedo, "normals roughness", shape=high),
        "+specular": traced(albedo, gloss, shape=high),
        "+cavity": traced(albedo, f"{gloss} cavity", shape=high),
        "own": traced(albedo, shape=face.own),
        "open": open_light + of_lamps,
        "+occlusion": occlusion * open_light + of_lamps,
    }
    relit = dict[str, FloatArray]()
    known = file.with_name(f"{file.stem}_albedo.png")
    if known.is_file():
        picture = cv2.resize(read_image_linear(known), scan.texture_linear.shape[1::-1])
        true = color_of(picture)
        own |= {"true": traced(true), "true+": traced(true, gloss, shape=high)}
        truth = ScanTruth.read(file.parent, file.stem)
        placed = transform_points(truth.scan_from_truth, truth.vertices_mm) * truth.unit_mm
        head = split(transform_points(fitted.model_from_scan, placed), truth.faces, truth.uv_corners)
        light = studio.light((RELIT,), EnvironmentLight.constant())
        bsdf = {"type": "principled", "base_color": studio.bitmap(truth.albedo_linear), "specular": 0.0}
        there = studio.picture(PATH, face=studio.mesh(head, bsdf=bsdf), **light)
        seen = seen_at(head) & counted
        seen &= studio.shining(head, truth.albedo_linear).min(-1) > 0.01
        there *= auto_exposure(there[seen])
        relit = {
            "lit": traced(lit, "normals", shape=high),
            "constant": traced(constant, "normals", shape=high),
            "albedo": traced(albedo),
            "+normals": traced(albedo, "normals"),
            "+displaced": traced(albedo, "normals", shape=high),
            "own": traced(albedo, shape=face.own),
            "true": traced(true, "normals", shape=high),
        }
        relit_pictures = {name: (made, there, seen) for name, made in relit.items()}
    else:
        relit_pictures = {}
    return {name: (made, photographs, counted) for name, made in own.items()}, relit_pictures


def sheet(pictures: Pictures, columns: int = 5) -> NDArray[np.uint8]:
    """Return the reference and all pictures, each in its best exposure, row by row."""
    reference = next(iter(pictures.values()))[1]
    panels = [encode_srgb_bytes(np.clip(reference, 0, 1))]
    for made, true, counted in pictures.values():
        panels.append(encode_srgb_bytes(np.clip(likeness(made, true, counted)[1] * made, 0, 1)))
    panels += [np.zeros_like(panels[0])] * (-len(panels) % columns)
    rows = [np.concatenate(panels[k : k + columns], 1) for k in range(0, len(panels), columns)]
    return np.concatenate(rows)


def main() -> None:
    """Print the likeness of each scan's pictures, and means over the scans whose albedo is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scan", nargs="*", type=Path, help="files; all that are known when omitted")
    parser.add_argument("--texels", type=int, default=384, help="of a side of the maps")
    parser.add_argument("--size", type=int, default=200, help="pixels of a side of the pictures")
    parser.add_argument("--paths", type=int, default=36, help="a pixel")
    parser.add_argument("--pictures", type=Path, help="folder to write the pictures into")
    chosen = parser.parse_args()
    files = chosen.scan or [file for pattern in SCANS for file in sorted(DATA.glob(pattern))]
    if not files:
        raise SystemExit(
            f"{DATA}: no scans; this command measures on faces that are not part of the repository"
        )
    print_row("PSNR dB", COLUMNS)
    print_row("relit, dB", RELIT_COLUMNS)
    complete: dict[str, list[list[float]]] = {"": [], "relit:": []}
    for file in files:
        both = pictures_of(file, chosen.texels, chosen.size, chosen.paths)
        for (prefix, kept), columns, pictures in zip(
            complete.items(), (COLUMNS, RELIT_COLUMNS), both, strict=True
        ):
            if not pictures:
                continue
            likenesses = {name: likeness(*three)[0] for name, three in pictures.items()}
            print_row(f"{prefix}{file.stem}", [likenesses.get(name, "-") for name in columns])
            if len(likenesses) == len(columns):
                kept.append(list(likenesses.values()))
            if chosen.pictures:
                chosen.pictures.mkdir(parents=True, exist_ok=True)
                name = f"{prefix}{file.stem}.png".replace(":", "_")
                Image.fromarray(sheet(pictures)).save(chosen.pictures / name)
    for prefix, kept in complete.items():
        if kept:
            print_row(f"{prefix}mean", np.mean(kept, axis=0).tolist())


def print_row(name: str, cells: Sequence[str | float]) -> None:
    """Print a row of the table, figures with one digit after the point."""
    text = [cell if isinstance(cell, str) else f"{cell:.1f}" for cell in cells]
    print(f"{name:22}" + " ".join(f"{cell:>10}" for cell in text), flush=True)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        main()
