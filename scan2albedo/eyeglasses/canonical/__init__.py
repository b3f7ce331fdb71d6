"""Frames brought to the mean of their key points, without pose and bend (S2)."""
