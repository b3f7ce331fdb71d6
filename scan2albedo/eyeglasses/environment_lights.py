"""Environment maps as sums of distant lights: `scan2albedo.lighting.environment` under the name used here."""

from scan2albedo.lighting.environment import DistantLights, distant_directions, environment_weights

__all__ = ["DistantLights", "distant_directions", "environment_weights"]
