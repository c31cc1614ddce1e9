"""Scan files: schema, reading part by part, writing."""
