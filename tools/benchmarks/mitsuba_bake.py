"""Measure what leaves each texel of a geometry image toward the viewer, by Mitsuba 3's path tracer.

Needs Mitsuba's `llvm_ad_rgb` variant, which wants a recent libLLVM (15 fails, 19 works; DRJIT_LIBLLVM_PATH
names the file).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import scan2albedo as s2a
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.geometry.rays import RayCaster

ABOVE_MM = 0.3
"""Camera rays start this far from the texel, so that nothing nearer the viewer hides it."""
INWARD = 0.005
"""Texels are vertices; their rays aim this part of the way into a triangle, where no other one can be hit."""
TILTS = (0.0, 0.15, 0.3, 0.6, 1.0, 2.0, 5.0)
"""The view direction leans toward the normal by these, until the texel's front can be seen."""
GRAZING = 0.05
"""Least cosine between the view direction and the normals: below, the answer is noise or black."""
_BATCH = 2**22
_EVEN = 64
"""Paths of one ray that are spread evenly; a square, as multijittered sampling wants it."""


@dataclass(frozen=True)
class Lamp:
    """A light of the scene; a sphere's radius makes it soft.

    Parameters
    ----------
    light : PointLight
        Relative to ambient radiance 1.
    radius_mm : float
        Of the disc that shines toward the origin; 0 is a point (or a distant light).
    """

    light: s2a.PointLight
    radius_mm: float = 0.0


def emitters_of(mitsuba: Any, lamp: Lamp | None) -> dict[str, Any]:
    """Return Mitsuba's description of a lamp, or of ambient light of radiance 1 for None.

    Our irradiance factor E is free of pi: a Lambert surface facing the lamp at the origin has radiance
    albedo E, Mitsuba's albedo / pi times the irradiance. A disc of area pi r^2 with radiance E d^2 / r^2 at
    distance d gives the irradiance pi E there.
    """
    if lamp is None:
        # A sky is best sampled by the BSDF alone (ten times less noise): the emitter picked gives nothing.
        sky = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}, "sampling_weight": 0.0}
        dark = {"type": "point", "position": [0, 0, 1e4], "intensity": {"type": "rgb", "value": 0.0}}
        return {"sky": sky, "dark": dark}
    return {"lamp": _lamp(mitsuba, lamp)}


def _lamp(mitsuba: Any, lamp: Lamp) -> dict[str, Any]:
    light = lamp.light
    if np.isinf(light.distance_mm):
        irradiance = float(np.pi * light.intensity)
        return {
            "type": "directional",
            "direction": (-light.direction).tolist(),
            "irradiance": {"type": "rgb", "value": irradiance},
        }
    position = (light.distance_mm * light.direction).tolist()
    if lamp.radius_mm == 0:
        intensity = float(np.pi * light.intensity * light.distance_mm**2)
        return {"type": "point", "position": position, "intensity": {"type": "rgb", "value": intensity}}
    transform = mitsuba.ScalarTransform4f
    radiance = float(light.intensity * (light.distance_mm / lamp.radius_mm) ** 2)
    return {
        "type": "disk",
        "to_world": transform().look_at(origin=position, target=[0, 0, 0], up=[0, 1, 0])
        @ transform().scale([lamp.radius_mm] * 3),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }


def measured_from(
    vertices: FloatArray, normals: FloatArray, faces: IntArray
) -> tuple[FloatArray, FloatArray, int]:
    """Return points just inside a triangle beside each vertex, directions to the viewer (V, 3), misses.

    The viewer is far along +z. Where the surface turns away from there, the direction leans toward the
    normal by as little as shows the front.
    """
    geometric, caster = face_normals(vertices, faces), RayCaster(vertices, faces)
    corner_vertex, corner_face = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    target, toward = vertices.copy(), normals.copy()
    open_ = np.ones(len(vertices), bool)
    for tilt in TILTS:
        view = normalized(np.array([0.0, 0.0, 1.0]) + tilt * normals)
        facing = np.einsum("ij,ij->i", geometric[corner_face], view[corner_vertex])
        best = np.full(len(vertices), -1)
        order = np.argsort(facing)  # the last one written is the triangle that faces the viewer most
        best[corner_vertex[order]] = corner_face[order]
        inside = vertices + INWARD * (vertices[faces[best]].mean(1) - vertices)
        hit = caster.first_hit(inside + ABOVE_MM * view, -view).face
        seen = (hit == best) & (np.einsum("ij,ij->i", geometric[best], view) > GRAZING)
        seen &= open_ & (np.einsum("ij,ij->i", normals, view) > GRAZING)
        target[seen], toward[seen] = inside[seen], view[seen]
        open_ &= ~seen
    target[open_] = inside[open_]
    return target, toward, int(open_.sum())


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
    mesh = mitsuba.Mesh(
        name,
        len(vertices),
        len(faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


class Bake:
    """A surface in Mitsuba, ready to be lit by one emitter at a time.

    Parameters
    ----------
    vertices, normals : (V, 3) float64
        The texels, millimetres; smooth unit normals.
    faces : (F, 3) int64
    mask : (H, W) bool
        Which texels the vertices are, in row-major order.
    albedo_linear : (V, 3) float64
    bsdf : dict
        Mitsuba's BSDF; `albedo_slot` names its parameter that takes the albedo.
    albedo_slot : str
    """

    def __init__(
        self,
        vertices: FloatArray,
        normals: FloatArray,
        faces: IntArray,
        mask: BoolArray,
        albedo_linear: FloatArray,
        bsdf: dict[str, Any],
        albedo_slot: str,
        threads: int = 1,
    ) -> None:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(threads)
        self._mi, self._dr = mitsuba, drjit
        properties = mitsuba.Properties()
        picture = np.zeros((*mask.shape, 3), np.float32)
        picture[mask] = albedo_linear
        # No interpolation: a ray that hits beside its texel's centre still finds that texel's own albedo.
        texture = {
            "type": "bitmap",
            "data": mitsuba.TensorXf(picture),
            "raw": True,
            "filter_type": "nearest",
        }
        properties["bsdf"] = mitsuba.load_dict({**bsdf, albedo_slot: texture})
        row, column = np.nonzero(mask)
        uv = (np.stack([column, row], 1) + 0.5) / np.array(mask.shape[::-1])
        mesh = textured_mesh(mitsuba, vertices, normals, faces, uv, properties)
        self._mesh = mesh
        self.target, self.toward, self.misses = measured_from(vertices, normals, faces)

    def radiance(self, lamp: Lamp | None, *, paths: int, depth: int, seed: int = 0) -> FloatArray:
        """Return (V, 3) the radiance toward the viewer under one lamp (None: ambient light of radiance 1).

        Parameters
        ----------
        lamp : Lamp or None
        paths : int
            Paths a texel.
        depth : int
            Longest path in edges; 2 is direct light alone.
        seed : int
        """
        mi, dr = self._mi, self._dr
        scene = mi.load_dict({"type": "scene", "surface": self._mesh, **emitters_of(mi, lamp)})
        start = self.target + ABOVE_MM * self.toward
        return trace(mi, dr, scene, start, -self.toward, paths=paths, depth=depth, seed=seed)


def trace(
    mitsuba: Any,
    drjit: Any,
    scene: Any,
    start: FloatArray,
    direction: FloatArray,
    *,
    paths: int,
    depth: int,
    seed: int = 0,
    sampler: str = "independent",
) -> FloatArray:
    """Return (N, 3) the mean radiance that arrives at `start` (N, 3) against unit `direction` (N, 3).

    `paths` a ray, of at most `depth` edges; "multijitter" spreads each ray's samples evenly, 64 at a time.
    """
    integrator = mitsuba.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
    count = len(start)
    repeats = max(1, min(paths, _BATCH // count))
    if sampler != "independent":
        repeats = _EVEN
    drawn = mitsuba.load_dict({"type": sampler, "sample_count": repeats})
    if sampler != "independent":
        drawn.set_samples_per_wavefront(repeats)
    ray_of = drjit.arange(mitsuba.UInt32, count * repeats) // repeats

    def spread(values: FloatArray) -> Any:
        columns = [mitsuba.Float(np.ascontiguousarray(c, np.float32)) for c in values.T]
        return drjit.gather(mitsuba.Point3f, mitsuba.Point3f(*columns), ray_of)

    rays = mitsuba.RayDifferential3f(spread(start), mitsuba.Vector3f(spread(direction)))
    total = np.zeros((count, 3))
    rounds = -(-paths // repeats)
    for turn in range(rounds):
        drawn.seed(1000 * seed + turn, count * repeats)
        spectrum, _, _ = integrator.sample(scene, drawn, rays)
        for c in range(3):
            total[:, c] += np.array(drjit.block_reduce(drjit.ReduceOp.Add, spectrum[c], repeats))
    return total / (rounds * repeats)
