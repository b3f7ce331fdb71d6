"""Peers of the albedo stage that search: SciPy's annealing, and gradient descent through Mitsuba / Dr.Jit.

Both work on V of a geometry image and are told how many lights there are; neither uses `scan2albedo.albedo`.
The second needs Mitsuba's `llvm_ad_rgb` variant and with it a libLLVM that DRJIT_LIBLLVM_PATH names (15
fails, 19 works).
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import dual_annealing

import scan2albedo as s2a
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.shading import Reflectance, light_from_direction, shade_points
from scan2albedo.lighting.shadow_map import ShadowMap

WHITE = 0.995
"""Texels from here on say nothing about light."""
BLOCK_AREA = 0.125
"""Of a block of the objective, as a part of the chart: blocks have to be larger than the texture's grain."""
EXCESS = 3.0
"""Price of a highlight that is brighter than its texel, relative to other residuals."""
OFFSET_MM = 0.2
"""Shadow rays start this far above the surface."""


_DIMMEST = 0.03
"""Least light, of an ambient light of 1: the sum of an environment may come near 0."""


@dataclass(frozen=True)
class PeerAnswer:
    """Unlit V (H, W), the lights found (ambient = 1), CPU seconds with compilation, evaluations or steps."""

    albedo_value: FloatArray
    lights: tuple[s2a.PointLight, ...]
    cpu_s: float
    evaluations: int


def annealed(
    image: s2a.GeometryImage,
    light_count: int,
    *,
    evaluations: int = 4000,
    local_search: bool = False,
    seed: int = 0,
) -> PeerAnswer:
    """Minimise the block residual over distant lights, Oren-Nayar and Phong by generalised annealing.

    Per light two angles and the logarithm of its strength; sigma, k_s and the logarithm of Phong's exponent
    are common. The objective is sum |T - I_s - a_b I| / sum T over blocks b with the least-squares albedo
    a_b, in four partitions that are half a block apart.

    Parameters
    ----------
    image : GeometryImage
    light_count : int
    evaluations : int
        Bound on evaluations of the objective.
    local_search : bool
        Follow good points by L-BFGS-B, as SciPy does unless told otherwise.
    seed : int

    References
    ----------
    .. [1] Y. Xiang, D. Y. Sun, W. Fan, X. G. Gong, "Generalized simulated annealing algorithm and its
       application to the Thomson model", Physics Letters A 233, 1997.
    """
    started = time.process_time()
    mask, value = image.mask, _value(image)
    position, normal = image.position[mask], image.normal[mask]
    shadows = ShadowMap(RayCaster(*image.occluder_mesh()), position, normal, OFFSET_MM)
    weight = (value < WHITE).astype(float)
    blocks = _blocks(mask)

    def shade(x: FloatArray) -> tuple[list[s2a.PointLight], FloatArray, FloatArray]:
        lights = [
            s2a.PointLight(float(a), float(e), math.inf, math.exp(s))
            for a, e, s in x[: 3 * light_count].reshape(-1, 3)
        ]
        sigma, strength, exponent = x[3 * light_count :]
        reflectance = Reflectance("oren-nayar", float(sigma), float(strength), math.exp(exponent))
        visible = np.stack([shadows.visible(light.direction) for light in lights])
        shading = shade_points(
            position,
            normal,
            lights,
            reflectance,
            visible=visible,
            specular_scale=None if image.specular_scale is None else image.specular_scale[mask],
        )
        return lights, shading.light, shading.specular

    def cost(x: FloatArray) -> float:
        _, light, specular = shade(x)
        return block_residual(value, weight, light, specular, blocks)

    angles = [(-1.9, 1.9), (-1.4, 1.4), (math.log(0.1), math.log(20))]
    bounds = angles * light_count + [(0.0, 0.8), (0.0, 0.3), (math.log(2), math.log(100))]
    found = dual_annealing(
        cost,
        bounds,
        maxiter=10**6,
        maxfun=evaluations,
        no_local_search=not local_search,
        rng=np.random.default_rng(seed),
    )
    lights, light, specular = shade(found.x)
    albedo = np.zeros(mask.shape)
    albedo[mask] = np.maximum(value - specular, 0) / light
    return PeerAnswer(albedo, tuple(lights), time.process_time() - started, int(found.nfev))


def block_residual(
    value: FloatArray, weight: FloatArray, light: FloatArray, specular: FloatArray, blocks: IntArray
) -> float:
    """Return sum w |T - I_s - a_b I| / sum w T, the mean over partitions (S, N) into blocks b.

    a_b = sum w (T - I_s) I / sum w I^2. What a highlight exceeds its texel by costs `EXCESS` times more.
    """
    rest, count, total = value - specular, int(blocks.max()) + 1, 0.0
    for block in blocks:
        top = np.bincount(block, weight * rest * light, count)
        bottom = np.bincount(block, weight * light * light, count)
        albedo = np.maximum(top, 0) / np.where(bottom > 0, bottom, 1)
        total += float(np.sum(weight * np.abs(rest - light * albedo[block])))
    excess = float(np.sum(weight * EXCESS * np.maximum(-rest, 0)))
    return (total / len(blocks) + excess) / float(np.sum(weight * value))


def _blocks(mask: BoolArray) -> IntArray:
    """Return (4, N) block indices: squares of `BLOCK_AREA` of the chart, moved by half a block each way."""
    side = math.sqrt(BLOCK_AREA * mask.sum())
    row, column = np.nonzero(mask)
    moved = itertools.product((0.0, 0.5), repeat=2)
    wide = int(max(mask.shape) / side) + 2
    return np.stack([(row / side + r).astype(int) * wide + (column / side + c).astype(int) for r, c in moved])


ONE_LIGHT_STARTS_DEG = ((0, 0), (45, 0), (-45, 0), (0, 45), (75, 0), (-75, 0))
"""Azimuth and elevation; of two lights all pairs of the first four."""


@dataclass(frozen=True)
class DescentOptions:
    """Settings of `mitsuba_inverse`, the best of those tried on three scenes of the path-traced set."""

    variation_weight: float = 3.0
    """Weight of the total variation of log albedo, relative to the mean residual on mean V."""
    trial_steps: int = 100
    """Adam steps from each start."""
    steps: int = 500
    """Adam steps from the best of them, and as many again at a `slower` pace."""
    slower: float = 5.0
    """Divides all of Adam's steps toward the end."""
    light_rate: float = 0.03
    """Adam's step for directions, log strengths and 1000 mm / distance."""
    albedo_rate: float = 0.05
    """Adam's step for log albedo."""
    near: bool = True
    """Also fit the lights' distance, common to all."""
    environment: int = 0
    """Distant directions of an environment past the surface's own shadows; their radiances are fitted in
    place of constant ambient light, which 0 keeps."""
    threads: int = 1


def mitsuba_inverse(
    image: s2a.GeometryImage, light_count: int, options: DescentOptions = DescentOptions()
) -> PeerAnswer:
    """Descend by Adam on lights and a free albedo texture, through Dr.Jit's automatic differentiation.

    minimises  mean |A I(theta) - T| / mean T + w mean |grad log A|,  I = 1 + sum_k s_k V_k max(0, n.l_k) f_k

    over log A (a number a texel) and theta: directions, log strengths, the inverse distance. Visibility V is
    ray-traced by Mitsuba anew at every step and held constant in the gradient. Ambient light is 1: the total
    variation of the logarithm does not see a common scale. Several starts run shortly, the best one on. What
    is returned is T / I, which keeps the detail that the variation would smooth away. With an environment of
    directions w_j, I has the sum of r_j V_j max(0, n.w_j), of mean 1 where all r_j are 1, in place of 1.

    References
    ----------
    .. [1] W. Jakob, S. Speierer, N. Roussel, D. Vicini, "Dr.Jit: A Just-In-Time Compiler for Differentiable
       Rendering", ACM Transactions on Graphics 41(4), 2022.
    .. [2] D. P. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015.
    """
    started = time.process_time()
    descent = _Descent(image, options)
    starts: list[tuple[tuple[int, int], ...]] = [(s,) for s in ONE_LIGHT_STARTS_DEG]
    if light_count > 1:
        starts = list(itertools.combinations(ONE_LIGHT_STARTS_DEG[: light_count + 2], light_count))
    directions = [np.array([_direction(a, e) for a, e in start]) for start in starts]
    trials = [descent.begin(d) for d in directions]
    losses = [descent.advance(optimizer, options.trial_steps) for optimizer in trials]
    best = trials[int(np.argmin(losses))]
    descent.advance(best, options.steps)
    descent.pace(best, 1 / options.slower)
    descent.advance(best, options.steps)
    steps = len(starts) * options.trial_steps + 2 * options.steps
    return PeerAnswer(descent.albedo(best), descent.lights(best), time.process_time() - started, steps)


class _Descent:
    """The texels in Dr.Jit, and what Adam does with them."""

    def __init__(self, image: s2a.GeometryImage, options: DescentOptions) -> None:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(options.threads)
        self._mi, self._dr, self._options = mitsuba, drjit, options
        self._mask, value = image.mask, _value(image)
        self._value_numpy = value
        self._scene = _scene_of(mitsuba, *image.occluder_mesh())
        position, normal = image.position[image.mask], image.normal[image.mask]
        self._position, self._normal = self._points(position), mitsuba.Normal3f(self._points(normal))
        self._origin = self._points(position + OFFSET_MM * normal)
        toward = distant_directions(options.environment) if options.environment else np.zeros((0, 3))
        open_sky = [self._reached(w, normal @ w) for w in toward]
        most = float(np.mean(sum(open_sky))) if open_sky else 1.0
        self._sky = np.array(open_sky) / most
        self._value = mitsuba.Float(value.astype(np.float32))
        self._weight = mitsuba.Float((value < WHITE).astype(np.float32))
        index = np.full(image.shape, -1)
        index[image.mask] = np.arange(len(value))
        pairs = np.concatenate(
            [np.stack([index[:, :-1], index[:, 1:]], -1), np.stack([index[:-1].T, index[1:].T], -1)], None
        ).reshape(-1, 2)
        self._pairs = [mitsuba.UInt32(p.astype(np.uint32)) for p in pairs[(pairs >= 0).all(1)].T]

    def _points(self, values: FloatArray) -> Any:
        columns = [self._mi.Float(np.ascontiguousarray(c, np.float32)) for c in values.T]
        return self._mi.Point3f(*columns)

    def _reached(self, toward: FloatArray, cosine: FloatArray) -> FloatArray:
        """Return (N,) the cosine of a distant light at the texels that it reaches, else 0."""
        direction = self._mi.Vector3f(*[self._mi.Float(float(c)) for c in toward])
        hidden = np.array(self._scene.ray_test(self._mi.Ray3f(self._origin, direction)))
        return np.where(hidden, 0.0, np.maximum(cosine, 0.0))

    def begin(self, directions: FloatArray) -> Any:
        """Return Adam at lights of strength 2 in `directions` (L, 3), the albedo what they leave."""
        mi = self._mi
        optimizer = mi.ad.Adam(lr=self._options.light_rate)
        optimizer["nearness"] = mi.Float(0.3 if self._options.near else 0.0)
        for k, direction in enumerate(directions):
            optimizer[f"direction{k}"] = mi.Vector3f(*[mi.Float(float(c)) for c in direction])
            optimizer[f"strength{k}"] = mi.Float(math.log(2.0))
        if len(self._sky):
            optimizer["radiance"] = mi.Float(np.zeros(len(self._sky), np.float32))
        light = self._light(optimizer, len(directions), self._soft(optimizer))
        log_albedo = self._dr.log(self._dr.maximum(self._value, 1 / 255) / light)
        optimizer["log_albedo"] = self._dr.detach(log_albedo)
        self.pace(optimizer, 1.0)
        return optimizer

    def pace(self, optimizer: Any, factor: float) -> None:
        """Set Adam's steps to `factor` times those of the options."""
        options = self._options
        rates = dict.fromkeys(optimizer.keys(), options.light_rate * factor)
        rates["log_albedo"] = options.albedo_rate * factor
        if not options.near:
            rates["nearness"] = 0.0
        optimizer.set_learning_rate(rates)

    def _soft(self, optimizer: Any) -> Any:
        """Return the environment's light on all texels, the ambient light of 1 without one."""
        if not len(self._sky):
            return self._mi.Float(1.0)
        radiance = np.exp(np.array(optimizer["radiance"], np.float64))
        return self._mi.Float((radiance @ self._sky).astype(np.float32))

    def _light(self, optimizer: Any, count: int, soft: Any) -> Any:
        """Return I of all texels, differentiable but for the visibility."""
        mi, dr = self._mi, self._dr
        light = mi.Float(soft)
        # With u = d - q x / (1000 mm), the light at 1000 mm / q lies along u and falls off as 1 / |u|^2.
        near = optimizer["nearness"] * 1e-3
        for k in range(count):
            offset = dr.normalize(optimizer[f"direction{k}"]) - near * mi.Vector3f(self._position)
            reach = dr.norm(offset)
            toward = offset / reach
            hidden = self._scene.ray_test(mi.Ray3f(self._origin, dr.detach(toward)))
            cosine = dr.maximum(0.0, dr.dot(toward, self._normal)) / dr.square(reach)
            light += dr.exp(optimizer[f"strength{k}"]) * dr.select(hidden, 0.0, cosine)
        return dr.maximum(light, _DIMMEST)

    def advance(self, optimizer: Any, steps: int) -> float:
        """Take Adam steps and return the last loss."""
        mi, dr = self._mi, self._dr
        count = _light_count(optimizer)
        scale = float(np.sum(self._value_numpy[self._value_numpy < WHITE]))
        loss = mi.Float(0.0)
        for _ in range(steps):
            log_albedo, soft = optimizer["log_albedo"], self._soft(optimizer)
            dr.enable_grad(soft)
            light = self._light(optimizer, count, soft)
            residual = dr.abs(dr.exp(log_albedo) * light - self._value) * self._weight
            first, second = (dr.gather(mi.Float, log_albedo, p) for p in self._pairs)
            variation = dr.sum(dr.abs(first - second)) / len(self._pairs[0])
            loss = dr.sum(residual) / scale + self._options.variation_weight * variation
            dr.backward(loss)
            if len(self._sky):
                # By NumPy: Dr.Jit would run through all texels once for each direction.
                slope = self._sky @ np.array(dr.grad(soft), np.float64)
                radiance = optimizer["radiance"]
                dr.set_grad(radiance, dr.exp(dr.detach(radiance)) * mi.Float(slope.astype(np.float32)))
            optimizer.step()
            optimizer["nearness"] = dr.clip(dr.detach(optimizer["nearness"]), 0.0, 2.5)
            for k in range(count):
                optimizer[f"direction{k}"] = dr.normalize(dr.detach(optimizer[f"direction{k}"]))
                strength = dr.detach(optimizer[f"strength{k}"])
                optimizer[f"strength{k}"] = dr.clip(strength, math.log(0.05), math.log(20.0))
        return float(np.array(loss)[0])

    def albedo(self, optimizer: Any) -> FloatArray:
        found = self._light(optimizer, _light_count(optimizer), self._soft(optimizer))
        light = np.array(self._dr.detach(found), np.float64)
        full = np.zeros(self._mask.shape)
        full[self._mask] = self._value_numpy / light
        return full

    def lights(self, optimizer: Any) -> tuple[s2a.PointLight, ...]:
        nearness = float(np.array(optimizer["nearness"])[0])
        distance = 1000 / nearness if nearness > 0 else math.inf
        return tuple(
            light_from_direction(
                np.array(optimizer[f"direction{k}"]).ravel(),
                distance,
                math.exp(float(np.array(optimizer[f"strength{k}"])[0])),
            )
            for k in range(_light_count(optimizer))
        )


def _light_count(optimizer: Any) -> int:
    return sum(key.startswith("direction") for key in optimizer.keys())  # noqa: SIM118 (no mapping)


def _scene_of(mitsuba: Any, vertices: FloatArray, faces: IntArray) -> Any:
    """Return a scene that holds one mesh, for its rays."""
    mesh = mitsuba.Mesh("surface", len(vertices), len(faces))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mitsuba.load_dict({"type": "scene", "surface": mesh})


def _direction(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    return s2a.PointLight(math.radians(azimuth_deg), math.radians(elevation_deg)).direction


def _value(image: s2a.GeometryImage) -> FloatArray:
    """Return (N,) V of the masked texels."""
    assert image.texture_linear is not None
    return image.texture_linear[image.mask].astype(np.float64).max(1)


SLOW_PEERS: dict[str, Callable[[s2a.GeometryImage, int], PeerAnswer]] = {
    "annealing 1000": partial(annealed, evaluations=1000),
    "annealing 4000": partial(annealed, evaluations=4000),
    "annealing 1000 local": partial(annealed, evaluations=1000, local_search=True),
    "Mitsuba gradients": mitsuba_inverse,
}
