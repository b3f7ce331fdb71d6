"""What every stage speaks: scans, geometry images, lamps, budgets, plans and traces."""

from scan2albedo.core.budget import (
    Budget,
    BudgetLike,
    Meter,
    OnProgress,
    ProgressCallback,
    Trace,
    TraceRow,
    checked_seed,
)
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.lights import EnvironmentLight, PointLight
from scan2albedo.core.plan import Plan, PlanStep
from scan2albedo.core.raw_scan import RawScan

__all__ = [
    "Budget",
    "BudgetLike",
    "EnvironmentLight",
    "GeometryImage",
    "Meter",
    "OnProgress",
    "Plan",
    "PlanStep",
    "PointLight",
    "ProgressCallback",
    "RawScan",
    "Trace",
    "TraceRow",
    "checked_seed",
]
