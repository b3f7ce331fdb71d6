"""Simulated annealing."""

from scan2albedo.optimization.annealing import AnnealingOptions, AnnealingResult, simulated_annealing

__all__ = ["AnnealingOptions", "AnnealingResult", "simulated_annealing"]
