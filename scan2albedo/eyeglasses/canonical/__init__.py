"""Frames brought to their mean key points."""
