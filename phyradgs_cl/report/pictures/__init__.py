"""Slices and projections as PNG, and how the page looks through them."""
