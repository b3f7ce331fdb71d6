"""Flash captures of heads that are not of the project, rendered by Mitsuba 3, with their truth.

Mitsuba finds what each ray hits, its position and shading normal (weighted by angle), the colours there and
whether the flash reaches it; with `bounces` its path tracer adds the light that the face throws on itself.
The lobes are written out here once more. Nothing of it is code that the benchmark measures.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.reflectance import (
    CaptureRig,
    OlatImages,
    OlatOptions,
    VertexReflectance,
    extract_olat,
)
from worlds.flash_captures import arc, highlights, unit
from worlds.light_stage import LightStage

DISTANCE_MM = 1000.0
"""Of cameras and flashes from the head."""
GAMMA = 1.2
"""Of the displayed values."""
NOISE = 0.008
"""Standard deviation of the displayed values, white being 1."""
ROOM = 0.02
"""Linear light of the room."""
SATURATION = 0.98
_SIDE = 2
"""Rays along each side of a pixel."""
_FIELD_MM = 260.0
"""What a picture shows at the head."""
Skin = tuple[float, float, float]
SKIN: Skin = (0.50, 0.34, 0.27)
"""Mean albedo."""


@dataclass(frozen=True)
class MitsubaCapture:
    """Pictures of a head (V vertices, mm) with its truth."""

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    """(V, 3): those that were rendered."""
    truth: VertexReflectance
    rig: CaptureRig
    olat: OlatImages
    view: IntArray
    """(J,)."""
    strength: float
    """Of the flashes, known to the fit."""
    inner: BoolArray
    """(V,): vertices of the face, without ears, neck and back of the head."""


def drawn_reflectance(vertices: FloatArray, lips: FloatArray, mean: Skin) -> VertexReflectance:
    """Return skin with blotches, grain, red lips and a gloss that varies; all albedos are 0.9 at most."""
    rng = np.random.default_rng(0)

    def cloud(size_mm: float) -> FloatArray:
        grid = rng.standard_normal((24, 24, 24))
        return map_coordinates(grid, (vertices / size_mm).T % 23, order=1, mode="wrap")

    blotch = 1 + 0.12 * cloud(35.0) + 0.08 * cloud(9.0) + 0.01 * rng.standard_normal(len(vertices))
    skin = np.minimum(np.array(mean) * np.clip(blotch, 0.5, 1.6)[:, None], 0.9)
    near = np.exp(-((np.linalg.norm(vertices - lips, axis=1) / 18.0) ** 2))[:, None]
    skin *= 1 - near * np.array([0.1, 0.4, 0.3])
    weights = np.array([0.10, 0.12, 0.08]) * np.clip(1 + 0.4 * cloud(30.0), 0.1, 2.5)[:, None]
    return VertexReflectance(skin, weights, np.ones(len(vertices), bool))


@cache
def mitsuba_capture(
    name: str = "person1",
    *,
    views: int = 6,
    flashes: int = 8,
    size: int = 256,
    bounces: bool = False,
    skin: Skin = SKIN,
    rays: int = 16,
) -> MitsubaCapture:
    """Return pictures, 8 bits with noise, of every view lit by every flash; `rays` a pixel if it bounces."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    stage = LightStage.load()
    faces, landmarks = stage.face_area, stage.landmarks
    vertices = stage.shapes[name][: faces.max() + 1]
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    truth = drawn_reflectance(vertices, vertices[landmarks[48:]].mean(0), skin)
    cameras = np.concatenate([arc(np.linspace(-55, 55, views - 1)), arc(np.zeros(1), 25)])
    lights = np.concatenate([arc(np.linspace(-65, 65, flashes - 3), 8), arc(np.array([-30.0, 0, 30]), 42)])
    lights[: flashes - 3] += [40.0, 30.0, 0.0]  # beside the cameras, not in them
    focal_px = size * DISTANCE_MM / _FIELD_MM
    aimed = partial(look_at, target=np.zeros(3), focal_px=focal_px, shape=(size, size))
    matrices = np.stack([aimed(position) for position in cameras])
    body = _Scene(mi, vertices, faces, truth)
    clean = []
    for position in cameras:
        for light in lights:
            clean.append(body.radiance(position, light, size, rays if bounces else 0))
    view, number = np.repeat(np.arange(views), flashes), np.tile(np.arange(flashes), views)
    light = np.stack(clean)
    strength = 0.8 / float(np.percentile(light[light.max(-1) > 0.02], 99.0))
    rng = np.random.default_rng([0, 7])
    flash = _photograph(strength * light + ROOM, rng)
    room = _photograph(np.full((views, size, size, 3), ROOM), rng)
    options = OlatOptions(gamma=GAMMA, noise=NOISE, saturation=SATURATION)
    return MitsubaCapture(
        vertices,
        faces,
        body.normals,
        truth,
        CaptureRig(matrices[view], lights[number], number),
        extract_olat(flash, room[view], options=options),
        view,
        strength,
        _inner(vertices, landmarks),
    )


def _photograph(linear: FloatArray, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return displayed values of 8 bits with noise."""
    values = linear ** (1 / GAMMA) + NOISE * rng.standard_normal(linear.shape)
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _inner(vertices: FloatArray, landmarks: IntArray) -> BoolArray:
    """Return (V,) what is within the outline of the landmarks, seen from the front, with a forehead."""
    spots = vertices[landmarks, :2]
    low, high = spots.min(0), spots.max(0) + [0.0, 25.0]
    return ((vertices[:, :2] > low) & (vertices[:, :2] < high)).all(1) & (vertices[:, 2] > 0)


class _Scene:
    """The head in Mitsuba, once with its albedo and once with its weights as colour."""

    def __init__(self, mi: Any, vertices: FloatArray, faces: IntArray, truth: VertexReflectance) -> None:
        self._mi = mi
        self._skin = self._mesh(vertices, faces, truth.diffuse_linear)
        self._gloss = self._mesh(vertices, faces, truth.weights)
        self.normals = unit(np.array(mi.traverse(self._skin)["vertex_normals"], np.float64).reshape(-1, 3))

    def _mesh(self, vertices: FloatArray, faces: IntArray, color: FloatArray) -> Any:
        mi = self._mi
        color_of_vertex = {"type": "mesh_attribute", "name": "vertex_color"}
        inside = {"type": "diffuse", "reflectance": color_of_vertex}
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": inside})
        mesh = mi.Mesh("head", len(vertices), len(faces), has_vertex_normals=True, props=properties)
        mesh.add_attribute("vertex_color", 3, color.astype(np.float32).ravel())
        values = mi.traverse(mesh)
        values["vertex_positions"] = vertices.astype(np.float32).ravel()
        values["faces"] = faces.astype(np.uint32).ravel()
        mesh.recompute_vertex_normals()
        values.update()
        return mesh

    def radiance(self, position: FloatArray, light: FloatArray, size: int, bounced: int) -> FloatArray:
        """Return (H, W, 3) what the camera sees of a flash whose irradiance is 1 at `DISTANCE_MM`.

        With bounces, light is traced by `bounced` rays a pixel.
        """
        direct = {"type": "direct"}
        cells = size * _SIDE
        plain = self._rendered(self._skin, position, light, cells, _with_places(direct))
        weights = self._rendered(self._gloss, position, light, cells, _with_places(direct))[..., 3:6]
        lit = plain[..., :3].sum(-1) > 0
        place, normal = plain[..., 6:9], plain[..., 9:12]
        toward, back = light - place, position - place
        gloss = highlights(weights, normal, unit(toward), unit(back))
        falloff = DISTANCE_MM**2 / (toward**2).sum(-1)
        made = np.where(lit, falloff * gloss, 0.0)[..., None] + plain[..., :3] * (not bounced)
        made = made.reshape(size, _SIDE, size, _SIDE, 3).mean((1, 3))
        if bounced:
            every = {"type": "path", "max_depth": 7, "rr_depth": 100}
            made += self._rendered(self._skin, position, light, size, every, bounced)
        return np.asarray(made)

    def _rendered(
        self,
        mesh: Any,
        position: FloatArray,
        light: FloatArray,
        wide: int,
        kind: dict[str, Any],
        rays: int = 1,
    ) -> FloatArray:
        """Return (wide, wide, 3): radiance; or 12: colour, position and shading normal, too."""
        mi = self._mi
        transform = mi.ScalarTransform4f
        angle = 2 * np.degrees(np.arctan(_FIELD_MM / DISTANCE_MM / 2))
        scene = mi.load_dict(
            {
                "type": "scene",
                "head": mesh,
                "flash": {
                    "type": "point",
                    "position": light.tolist(),
                    "intensity": {"type": "rgb", "value": DISTANCE_MM**2},
                },
                "camera": {
                    "type": "perspective",
                    "fov": angle,
                    "to_world": transform().look_at(position.tolist(), [0, 0, 0], [0, 1, 0]),
                    "film": {
                        "type": "hdrfilm",
                        "width": wide,
                        "height": wide,
                        "rfilter": {"type": "box"},
                        "component_format": "float32",
                    },
                    "sampler": {"type": "multijitter" if rays > 1 else "independent", "sample_count": rays},
                },
                "integrator": kind,
            }
        )
        picture = np.array(mi.render(scene, seed=1), np.float64)
        if picture.shape[-1] <= 4:
            return picture[..., :3]
        return np.concatenate([picture[..., :3], picture[..., -9:]], axis=-1)


def _with_places(kind: dict[str, Any]) -> dict[str, Any]:
    """Return an integrator that also gives colour, position and shading normal."""
    return {"type": "aov", "aovs": "color:albedo,place:position,normal:sh_normal", "image": kind}
