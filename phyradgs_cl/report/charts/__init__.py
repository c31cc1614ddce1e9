"""Drawings as SVG: curves, geometry, shutter."""
