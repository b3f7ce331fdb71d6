"""Lenses: rims, refraction, light, pictures (S11 to S15)."""
