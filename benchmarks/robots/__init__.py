"""Robots from their MJCF: what simulating them costs."""
