"""Eyeglasses: weights that tie a frame to its key points, and the deformations they carry."""

from scan2albedo.eyeglasses.options import WeightOptions
from scan2albedo.eyeglasses.skinning import skin
from scan2albedo.eyeglasses.weights import (
    BoundedBiharmonicWeights,
    bounded_biharmonic_weights,
    solve_weights,
)

__all__ = [
    "BoundedBiharmonicWeights",
    "WeightOptions",
    "bounded_biharmonic_weights",
    "skin",
    "solve_weights",
]
