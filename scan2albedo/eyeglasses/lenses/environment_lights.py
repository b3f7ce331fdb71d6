"""Environment maps as sums of distant lights: `scan2albedo.lighting.environment` under the name used here."""

from scan2albedo.lighting.environment import (
    DistantLights,
    MapCells,
    distant_directions,
    environment_weights,
    map_cells,
)

__all__ = ["DistantLights", "MapCells", "distant_directions", "environment_weights", "map_cells"]
