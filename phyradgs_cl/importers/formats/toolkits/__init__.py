"""Formats of other toolkits: their geometries with frames beside them, and the raw files that they read."""
