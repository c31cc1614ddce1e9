"""Frames before a method sees them, pixels that it never sees, and frames computed from its volume."""
