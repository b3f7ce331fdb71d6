"""Synthetic scenes with ground truth."""

from scan2albedo.synthetic.raw_like import RawLikeOptions, raw_like

__all__ = ["RawLikeOptions", "raw_like"]
