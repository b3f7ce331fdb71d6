"""Meshes with pictures on them, path-traced by Mitsuba 3 one emitter at a time, along any rays.

`Studio` needs Mitsuba's `llvm_ad_rgb` variant, which wants libLLVM (DRJIT_LIBLLVM_PATH names the file).
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.synthetic.renderer import photograph
from worlds.lamps import Emitter, Rig

Gloss = Literal["matte", "skin", "oily", "coat"]
DEPTH = 6
"""Longest path in edges: four bounces between a lamp and the camera, and the camera's own edge."""
_CHUNK = 2**16
"""Rays at a time."""
_EVEN = 64
"""Paths of one ray that are spread evenly; a square, as multijittered sampling wants it."""
_LIGHT_LEVEL = 0.80
"""Exposure puts the brightest skin here, white being 1."""
_LIGHT_QUANTILE = 0.98
"""Part of the skin that is darker than that."""
NOISE = 0.008
"""Standard deviation of a white pixel's noise; it falls with the square root of the light."""


@dataclass(frozen=True)
class Part:
    """A mesh: `uv` (V, 2) counts rows of `albedo` (H, W, 3) downward; `gloss` (H, W) scales reflection."""

    name: str
    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    uv: FloatArray
    albedo: NDArray[np.float32]
    gloss: NDArray[np.float32] | None
    bsdf: Gloss


def rough_plastic(albedo: dict[str, Any], *, alpha: float, int_ior: float) -> dict[str, Any]:
    """Return Mitsuba's BSDF of a diffuse body under a rough film."""
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": alpha,
        "int_ior": int_ior,
        "nonlinear": False,
        "diffuse_reflectance": albedo,
    }


def bitmap(mitsuba: Any, values: NDArray[np.float32]) -> dict[str, Any]:
    """Return Mitsuba's texture of linear values (H, W, C)."""
    return {"type": "bitmap", "data": mitsuba.TensorXf(np.ascontiguousarray(values)), "raw": True}


def bsdf_of(part: Part, *, nearest: bool, mitsuba: Any) -> dict[str, Any]:
    """Return Mitsuba's BSDF of a part; whatever the gloss, its diffuse part is proportional to the albedo."""
    look_up = {"filter_type": "nearest" if nearest else "bilinear"}
    albedo = bitmap(mitsuba, part.albedo) | look_up
    diffuse = {"type": "diffuse", "reflectance": albedo}
    if part.bsdf == "matte":
        return {"type": "twosided", "bsdf": diffuse}
    if part.bsdf == "coat":
        metal = {"type": "roughconductor", "material": "none", "alpha": 0.2, "distribution": "ggx"}
        return {"type": "blendbsdf", "weight": 0.035, "a": diffuse, "b": metal}
    film = {"alpha": 0.35, "int_ior": 1.4} if part.bsdf == "skin" else {"alpha": 0.24, "int_ior": 1.5}
    shine = 0.6 if part.gloss is None else bitmap(mitsuba, part.gloss[..., None]) | look_up
    return rough_plastic(albedo, **film) | {"specular_reflectance": shine}


def textured_mesh(
    mitsuba: Any,
    vertices: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    uv: FloatArray,
    properties: Any,
    name: str = "surface",
) -> Any:
    """Return Mitsuba's mesh; `uv` (V, 2) counts rows of the picture downward, `properties` hold the BSDF."""
    corners = {"has_vertex_normals": True, "has_vertex_texcoords": True}
    mesh = mitsuba.Mesh(name, len(vertices), len(faces), props=properties, **corners)
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


class Studio:
    """Parts of a head in Mitsuba.

    Parameters
    ----------
    parts : list of Part
    nearest : bool
        Look the face's texels up without interpolation, for points that are texels.
    threads : int
    """

    def __init__(self, parts: list[Part], *, nearest: bool, threads: int = 1) -> None:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(threads)
        self._mi, self._dr, self._shapes = mitsuba, drjit, {}
        for part in parts:
            bsdf = bsdf_of(part, nearest=nearest and part.name == "face", mitsuba=mitsuba)
            properties = mitsuba.Properties()
            properties["bsdf"] = mitsuba.load_dict(bsdf)
            surface = part.vertices, part.normals, part.faces, part.uv
            self._shapes[part.name] = textured_mesh(mitsuba, *surface, properties, part.name)

    def radiance(
        self, emitter: Emitter, start: FloatArray, direction: FloatArray, *, paths: int, seed: int = 0
    ) -> FloatArray:
        """Return (N, 3) the radiance along rays under one emitter, white, of strength 1."""
        scene = self._mi.load_dict({"type": "scene", **self._shapes, **emitter.plugins(self._mi)})
        rounds = -(-max(_EVEN, int(paths * emitter.path_factor)) // _EVEN)
        parts = []
        for number, first in enumerate(range(0, len(start), _CHUNK)):
            rays = start[first : first + _CHUNK], direction[first : first + _CHUNK]
            parts.append(self._traced(scene, *rays, rounds, seed + 17 * number))
        return np.concatenate(parts)

    def _traced(
        self, scene: Any, start: FloatArray, direction: FloatArray, rounds: int, seed: int
    ) -> FloatArray:
        """Return (N, 3) the mean radiance against unit `direction` (N, 3), of `_EVEN` paths a round."""
        mi, dr = self._mi, self._dr
        integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": 1000})
        sampler = mi.load_dict({"type": "multijitter", "sample_count": _EVEN})
        sampler.set_samples_per_wavefront(_EVEN)
        ray_of = dr.arange(mi.UInt32, len(start) * _EVEN) // _EVEN

        def spread(values: FloatArray) -> Any:
            columns = [mi.Float(np.ascontiguousarray(c, np.float32)) for c in values.T]
            return dr.gather(mi.Point3f, mi.Point3f(*columns), ray_of)

        rays = mi.RayDifferential3f(spread(start), mi.Vector3f(spread(direction)))
        total = np.zeros((len(start), 3))
        for turn in range(rounds):
            sampler.seed(1000 * seed + turn, len(start) * _EVEN)
            spectrum, _, _ = integrator.sample(scene, sampler, rays)
            for c in range(3):
                total[:, c] += np.array(dr.block_reduce(dr.ReduceOp.Add, spectrum[c], _EVEN))
        return total / (rounds * _EVEN)


class LightTable:
    """Radiance of N rays under emitters, each traced once and shared between the rigs that hold it."""

    def __init__(
        self, studio: Studio, start: FloatArray, direction: FloatArray, paths: int, seed: int
    ) -> None:
        self._studio, self._rays, self._paths, self._seed = studio, (start, direction), paths, seed
        self._known: dict[Emitter, FloatArray] = {}

    def under(self, rig: Rig) -> FloatArray:
        """Return (N, 3) radiance under all parts of a rig."""
        return np.sum([part.linear * self._of(part.emitter) for part in rig.parts], axis=0)

    def _of(self, emitter: Emitter) -> FloatArray:
        if emitter not in self._known:
            seed = self._seed + 100 * len(self._known)
            self._known[emitter] = self._studio.radiance(emitter, *self._rays, paths=self._paths, seed=seed)
        return self._known[emitter]


def exposure_of(radiance: FloatArray) -> float:
    """Return the factor that puts the brightest skin (98 of 100 texels are darker) at 0.8 of white.

    >>> exposure_of(np.full((4, 3), 2.0))
    0.4
    """
    return _LIGHT_LEVEL / max(float(np.quantile(radiance.max(1), _LIGHT_QUANTILE)), 1e-9)


def stored(linear: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the linear picture decoded from 8 bits sRGB, with a sensor's noise: NOISE sqrt(light)."""
    noise = NOISE * np.sqrt(np.clip(linear, 0.01, 1)) * rng.standard_normal(linear.shape)
    return photograph(linear + noise, exposure=1.0, noise=0.0, bits=8, rng=rng).astype(float)
