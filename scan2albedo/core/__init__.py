"""What every stage speaks: scans, geometry images, lamps, budgets, plans and traces."""

from scan2albedo.core.budget import Budget, Meter, ProgressCallback, checked_seed
from scan2albedo.core.environment_light import EnvironmentLight
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.plan import Plan, PlanStep
from scan2albedo.core.point_light import PointLight
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.core.trace import Trace, TraceRow

__all__ = [
    "Budget",
    "EnvironmentLight",
    "GeometryImage",
    "Meter",
    "Plan",
    "PlanStep",
    "PointLight",
    "ProgressCallback",
    "RawScan",
    "Trace",
    "TraceRow",
    "checked_seed",
]
