"""Shared ground of every iterative stage: budgets, traces and simulated annealing."""

from scan2albedo.optimization.annealing import AnnealingOptions, AnnealingResult, simulated_annealing
from scan2albedo.optimization.budget import Budget, Meter, ProgressCallback, checked_seed
from scan2albedo.optimization.plan import Plan, PlanStep
from scan2albedo.optimization.trace import Trace, TraceRow

__all__ = [
    "AnnealingOptions",
    "AnnealingResult",
    "Budget",
    "Meter",
    "Plan",
    "PlanStep",
    "ProgressCallback",
    "Trace",
    "TraceRow",
    "checked_seed",
    "simulated_annealing",
]
