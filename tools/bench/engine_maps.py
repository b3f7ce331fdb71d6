"""Engine maps in a path tracer beside the raw scan's photographs: PSNR before and after each map joins.

Mitsuba renders the fitted face from the front with `engine_maps` on the model's chart, as its principled
material, under the light that was estimated. The reference of `own_light` is the raw scan, its own lit
texture shining by itself, in the same camera; that of `relit` the true head, matte, in another light, a lamp
at the side and an even sky. PSNR is of sRGB after the one exposure of all channels that suits best, where the
fitted face covers the scan within 4 mm. The methods:

texture    the lit texture on the fitted face, shining by itself: what shape and texels cost
constant   one colour, with all maps; lit: the lit texture, lit again, with all maps
lambert    the albedo, matte, without Mitsuba's Burley diffuse
albedo     the albedo in the principled material, matte; then what joins it, one after another:
+normals, +displaced, +roughness (and a gloss of F0 .04), +specular, +cavity (gloss times 2 c, at most 1)
own        the albedo, matte, with the displaced surface's own normals in place of the normal map
open, +occlusion     matte with normals, where nothing hides the soft light, and times the occlusion map,
           as engines without rays shade it
true, true+  the scan's true albedo, matte and smooth, and with all maps

Needs Mitsuba (`llvm_ad_rgb`, so DRJIT_LIBLLVM_PATH). `--pictures` gets reference and pictures of each scan.
"""

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from worlds.files import DATA
from worlds.lamps import environment_map
from worlds.path_tracer import bitmap, textured_mesh

import scan2albedo as s2a
from bench.judging import ScanTruth
from bench.runner import Bench, Case
from scan2albedo.applications import engine_maps, unlit_scan
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
from scan2albedo.unlit.template_baking import REACH_MM, Appearance, TemplateTexture, painted

SCANS = ("james.obj", "fran.obj", "traced/p*.obj", "real_skin/d_*.obj")
TEXELS = 384
"""Of a side of the maps."""
PIXELS = 200
"""Of a side of the pictures."""
PATHS = 36
"""A pixel."""
CAMERA_MM = 1000.0
"""From the face to the camera."""
FAR_MM = 20000.0
"""To lamps that are infinitely far."""
LEAST_RADIUS_DEG = 0.5
"""Of lamps that are points: Mitsuba's then have an outline like others."""
QUARTERED = 2
"""Times that the fitted face's triangles are divided before they are displaced: edges of some 0.4 mm."""
PATH = {"type": "path", "max_depth": 5, "rr_depth": 100}
SHINING = {"type": "path", "max_depth": 1}
LAMPS_ALONE = {"type": "path", "max_depth": 2}
RELIT = PointLight(-1.0, 0.5, np.inf, 3.0, radius_deg=6.0)
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
        middle = (low + high) / 2
        half = float((high - low)[:2].max() / 2)
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

    def picture(self, integrator: dict[str, Any], /, **things: Any) -> FloatArray:
        """Return (S, S, C) what the camera sees."""
        scene = {"type": "scene", "sensor": self._sensor, "integrator": integrator, **things}
        return np.array(self.mi.render(self.mi.load_dict(scene)), np.float64)

    def bitmap(self, values: NDArray) -> dict[str, Any]:
        """Return a linear texture (H, W) or (H, W, 3)."""
        return bitmap(self.mi, np.atleast_3d(values).astype(np.float32))

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
        plugins: dict[str, dict[str, Any]] = {}
        transform = self.mi.ScalarTransform4f
        for number, lamp in enumerate(lamps):
            distance = min(lamp.distance_mm, FAR_MM)
            radius = np.deg2rad(max(lamp.radius_deg, LEAST_RADIUS_DEG))
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

    class OpenSky(mi.SamplingIntegrator):
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


class Scene:
    """A processed scan in the studio: its baked face, colours (H, W, 3) by name, the scan's picture."""

    def __init__(self, file: Path, texels: int, size: int, paths: int) -> None:
        result = s2a.process(file)
        scan, self.fitted, self.estimate = result.scan, result.fitted, result.albedo
        unlit = unlit_scan(scan, self.fitted, self.estimate, "all").scan
        baked = engine_maps(unlit, self.fitted, self.estimate, "chart", texels)

        def color_of(texture: NDArray) -> NDArray:
            look = Appearance(self.fitted, replace(scan, texture_linear=texture))
            return np.asarray(painted(replace(baked, tiles=()), texels, look).tiles[0].color_linear)

        self.studio = Studio(self.fitted.vertices, size, paths)
        self.face = Face(self.studio, baked)
        tile = self.face.tile
        albedo = np.asarray(tile.color_linear)
        constant = np.broadcast_to(np.median(albedo[tile.seen], axis=0), albedo.shape)
        self.colors = {"albedo": albedo, "constant": constant, "lit": color_of(scan.texture_linear)}
        known = file.with_name(f"{file.stem}_albedo.png")
        self.file = file if known.is_file() else None
        if self.file:
            picture = cv2.resize(read_image_linear(known), scan.texture_linear.shape[1::-1])
            self.colors["true"] = color_of(picture)
        self.depth, cover = self.studio.depth_and_cover(self.face.flat)
        self.cover = cover & (self.studio.shining(self.face.flat, tile.seen)[..., 0] > 0.999)
        uv = in_first_period(scan.uv, scan.texture_linear.shape)
        raw = split(transform_points(self.fitted.model_from_scan, scan.vertices), scan.faces, uv)
        self.reference = self.studio.shining(raw, scan.texture_linear)
        self.counted = self.seen_at(raw)
        self.lamps = self.estimate.lights
        self.environment = self.estimate.environment or EnvironmentLight.constant()

    def seen_at(self, shape: Mesh) -> BoolArray:
        """Return the pixels (S, S) at which a shape covers the face nearby."""
        other, covered = self.studio.depth_and_cover(shape)
        return self.cover & covered & (np.abs(other - self.depth) < REACH_MM)

    def traced(self, color: str, maps: str = "", shape: str = "flat", lambert: bool = False) -> FloatArray:
        """Return the picture of the face in the scene's light."""
        mesh = {"flat": self.face.flat, "displaced": self.face.displaced, "own": self.face.own}[shape]
        surface = self.face.material(self.colors[color], maps, shape=mesh, lambert=lambert)
        return self.studio.picture(PATH, face=surface, **self.studio.light(self.lamps, self.environment))

    def in_the_open(self, occluded: bool) -> FloatArray:
        """Return the picture where nothing hides the soft light, perhaps times the occlusion map."""
        surface = self.face.material(self.colors["albedo"], "normals")
        sky = self.studio.light((), self.environment)
        soft = self.studio.picture({"type": "open_sky"}, face=surface, **sky)
        if occluded:
            soft = soft * self.studio.shining(self.face.flat, self.face.tile.maps["occlusion"])[..., :1]
        lamps = self.studio.light(self.lamps, None)
        return soft + (self.studio.picture(LAMPS_ALONE, face=surface, **lamps) if lamps else 0.0)


def split(vertices: FloatArray, faces: IntArray, uv: FloatArray) -> Mesh:
    parts = split_at_seams(faces, uv)
    return vertices[parts.vertex], vertex_normals(vertices, faces)[parts.vertex], parts.faces, parts.uv


@cache
def own_light(file: Path, texels: int, size: int, paths: int) -> Scene:
    return Scene(file, texels, size, paths)


def relit(file: Path, texels: int, size: int, paths: int) -> Scene:
    """Return the scene in another light, its reference the true head."""
    scene = own_light(file, texels, size, paths)
    if scene.file is None:
        raise s2a.ScanError("its true albedo is not known")
    truth = ScanTruth.read(file.parent, file.stem)
    placed = transform_points(truth.scan_from_truth, truth.vertices_mm) * truth.unit_mm
    head = split(transform_points(scene.fitted.model_from_scan, placed), truth.faces, truth.uv_corners)
    studio = scene.studio
    bsdf = {"type": "principled", "base_color": studio.bitmap(truth.albedo_linear), "specular": 0.0}
    other = copy(scene)
    other.lamps = (RELIT,)
    other.environment = EnvironmentLight.constant()
    light = studio.light(other.lamps, other.environment)
    there = studio.picture(PATH, face=studio.mesh(head, bsdf=bsdf), **light)
    other.counted = scene.seen_at(head) & scene.counted
    other.counted &= studio.shining(head, truth.albedo_linear).min(-1) > 0.01
    other.reference = there * auto_exposure(there[other.counted])
    return other


def cases(make: Callable[..., Scene], quick: bool) -> Iterator[Case]:
    detail = (64, 48, 4) if quick else (TEXELS, PIXELS, PATHS)
    files = [file for pattern in SCANS for file in sorted(DATA.glob(pattern))]
    if not files:
        raise FileNotFoundError(DATA)
    for file in files[2:3] if quick else files:
        known = file.with_name(f"{file.stem}_albedo.png").is_file()
        if known or make is own_light:
            yield Case(file.stem, partial(make, file, *detail), "albedo known" if known else "unknown")


def traced(color: str, maps: str = "", shape: str = "flat", lambert: bool = False) -> Callable[[Scene], Any]:
    """Return a method; it gives no picture where the colour is not known."""

    def picture(scene: Scene) -> FloatArray:
        if color not in scene.colors:
            raise s2a.ScanError("its true albedo is not known")
        return scene.traced(color, maps, shape, lambert)

    return picture


def psnr(scene: Scene, picture: FloatArray) -> dict[str, float]:
    return {"dB": likeness(picture, scene.reference, scene.counted)[0]}


def sheet(scene: Scene, pictures: Mapping[str, FloatArray]) -> NDArray[np.uint8]:
    """Return the reference and all pictures, each in its best exposure."""
    panels = [np.clip(scene.reference, 0, 1)]
    for made in pictures.values():
        exposure = likeness(made, scene.reference, scene.counted)[1]
        panels.append(np.clip(exposure * made, 0, 1))
    return encode_srgb_bytes(np.concatenate(panels, axis=1))


GLOSS = "normals roughness specular"
MATTE = {
    "albedo": traced("albedo"),
    "+normals": traced("albedo", "normals"),
    "+displaced": traced("albedo", "normals", "displaced"),
    "own": traced("albedo", "", "own"),
}
JUDGED: dict[str, Any] = {"score": psnr, "summaries": ("mean",), "picture": sheet}
BENCHES = {
    "own_light": Bench(
        partial(cases, own_light),
        methods=MATTE
        | {
            "texture": lambda scene: scene.studio.shining(scene.face.flat, scene.colors["lit"]),
            "constant": traced("constant", GLOSS, "displaced"),
            "lit": traced("lit", GLOSS, "displaced"),
            "lambert": traced("albedo", lambert=True),
            "+roughness": traced("albedo", "normals roughness", "displaced"),
            "+specular": traced("albedo", GLOSS, "displaced"),
            "+cavity": traced("albedo", f"{GLOSS} cavity", "displaced"),
            "open": lambda scene: scene.in_the_open(occluded=False),
            "+occlusion": lambda scene: scene.in_the_open(occluded=True),
            "true": traced("true"),
            "true+": traced("true", GLOSS, "displaced"),
        },
        **JUDGED,
    ),
    "relit": Bench(
        partial(cases, relit),
        methods=MATTE
        | {
            "lit": traced("lit", "normals", "displaced"),
            "constant": traced("constant", "normals", "displaced"),
            "true": traced("true", "normals", "displaced"),
        },
        **JUDGED,
    ),
}
