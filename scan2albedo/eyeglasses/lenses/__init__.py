"""Lenses: rims, refraction, light, pictures."""
