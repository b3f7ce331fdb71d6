"""Put synthetic glasses on a head: upright on the nose, temples spread until they clear its sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.synthetic.glasses import SyntheticEyeglasses, eyeglasses
from scan2albedo.synthetic.glasses_bend import GlassesBend
from scan2albedo.synthetic.glasses_shape import GlassesShape
from scan2albedo.synthetic.ray_scene import RayScene

FloatArray = NDArray[np.float64]

_FAR_MM = 300.0
_CLEARANCE_MM = 0.4
"""Between nose and frame, between head and temples."""
_TILT_DEG = 3.0
"""Lower rims lean towards the cheeks, as opticians fit them."""
_BELOW_EYES_MM = 3.0
_FRONT_MM = 12.0
"""What lies this far behind the hinges or less may touch the face."""
_WIDEST_SPREAD_MM = 16.0


def fit_temples(shape: GlassesShape, seed: int, head: RayScene, nose_top: FloatArray) -> GlassesBend:
    """Return the bend that spreads the temples of a frame around a head, and a little else at random.

    Parameters
    ----------
    shape : GlassesShape
    seed : int
        Of what is bent besides: the bridge by up to 3 degrees, the halves against each other by 2.
    head : RayScene
        Looking along +z, mm.
    nose_top : (3,) float64
        Where the frame will sit.
    """
    rng = np.random.default_rng([seed, 8])
    bend = GlassesBend(0.0, bridge_deg=rng.uniform(-3, 3), twist_deg=rng.uniform(-2, 2))
    straight = eyeglasses(shape=shape, bend=replace(bend, bridge_deg=0.0, twist_deg=0.0))
    placed = transform_points(seat(straight, head, nose_top), straight.vertices)
    hinge_z = straight.rest_keypoints[:, 2].max() - _FRONT_MM
    temple = straight.rest_vertices[:, 2] < hinge_z
    u = (hinge_z - straight.rest_vertices[temple, 2]) / (hinge_z - straight.rest_vertices[:, 2].min())
    side = np.sign(straight.rest_vertices[temple, 0])
    away = np.column_stack([side, np.zeros((len(side), 2))])
    hits = head.first_hit(placed[temple] + _FAR_MM * away, -away)
    lacking = _FAR_MM - hits.distance + _CLEARANCE_MM
    # Near the hinge no spread helps, so that the rest of the temple decides.
    reach = u**2 * (3 - u) / 2
    needed = np.where((hits.face >= 0) & (u > 0.4), lacking / np.maximum(reach, 1e-9), 0.0)
    spread = float(np.clip(needed.max(initial=0.0), 0.0, _WIDEST_SPREAD_MM))
    return replace(bend, temple_spread_mm=spread + rng.uniform(0, 2))


def seat(glasses: SyntheticEyeglasses, head: RayScene, eyes: FloatArray) -> FloatArray:
    """Return the rigid `world_from_glasses` (4, 4) of a frame that just touches the face at one point.

    Parameters
    ----------
    glasses : SyntheticEyeglasses
    head : RayScene
        Looking along +z, mm.
    eyes : (3,) float64
        Middle between the eyes, about.
    """
    tilt = rotation_from_vector([np.deg2rad(_TILT_DEG), 0, 0])
    start = compose(tilt, eyes + [0.0, -_BELOW_EYES_MM, _FAR_MM])
    front = glasses.vertices[:, 2] > glasses.keypoints[:, 2].max() - _FRONT_MM
    points = transform_points(start, glasses.vertices[front])
    hits = head.first_hit(points, np.array([0.0, 0, -1]))
    gap = float(hits.distance[hits.face >= 0].min())
    start[2, 3] -= gap - _CLEARANCE_MM
    return start
