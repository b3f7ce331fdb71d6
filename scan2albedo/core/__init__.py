"""What every stage speaks: scans, geometry images, lamps, budgets, plans and traces."""

from typing import TYPE_CHECKING

from scan2albedo.lazy import names_when_asked

if TYPE_CHECKING:
    from scan2albedo.core.budget import (
        Budget as Budget,
        BudgetLike as BudgetLike,
        Meter as Meter,
        OnProgress as OnProgress,
        ProgressCallback as ProgressCallback,
        Trace as Trace,
        TraceRow as TraceRow,
        checked_seed as checked_seed,
    )
    from scan2albedo.core.geometry_image import GeometryImage as GeometryImage
    from scan2albedo.core.lights import EnvironmentLight as EnvironmentLight, PointLight as PointLight
    from scan2albedo.core.plan import Plan as Plan, PlanStep as PlanStep
    from scan2albedo.core.raw_scan import RawScan as RawScan

__getattr__, __dir__, __all__ = names_when_asked(__name__, __file__)
