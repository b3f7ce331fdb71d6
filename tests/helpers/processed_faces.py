"""Synthetic people as if they had been processed: the truth of a scene in place of an estimate."""

from functools import cache

from scan2albedo import AnnotatedFaceModel
from scan2albedo.applications import ProcessedFace
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.synthetic import Material, face, light_at

MATERIAL = Material(0.3, 0.15, 20.0)


@cache
def person_scene(seed=0, expression="neutral", size=64):
    """Return a synthetic scene of a person's face."""
    return face(
        seed, expression=expression, size=size, material=MATERIAL, bits=None, lights=[light_at(30, 15)]
    )


@cache
def processed_person(seed=0, expression="neutral", size=64):
    """Return the truth of a person's scene as if it had been estimated."""
    made = person_scene(seed, expression, size)
    return ProcessedFace.of(
        f"person{seed}",
        made.image,
        made.albedo_linear,
        reflectance=Reflectance(
            "oren-nayar", MATERIAL.sigma_rad, MATERIAL.specular_strength, MATERIAL.specular_exponent
        ),
        lights=made.lights,
        model_name=AnnotatedFaceModel.default().name,
    )
