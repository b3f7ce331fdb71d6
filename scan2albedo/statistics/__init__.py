"""Linear models, robust losses, effective counts of correlated texels."""
