"""Benches of eyeglasses, and the frames they share."""
