"""Reflectance models, shadows and soft light."""
