"""Search for the least cost: simulated annealing and damped least squares."""

from scan2albedo.optimization.annealing import simulated_annealing
from scan2albedo.optimization.least_squares import (
    Damping,
    Descent,
    LeastSquaresPoint,
    NormalEquations,
    damped_step,
    minimize,
)

__all__ = [
    "Damping",
    "Descent",
    "LeastSquaresPoint",
    "NormalEquations",
    "damped_step",
    "minimize",
    "simulated_annealing",
]
