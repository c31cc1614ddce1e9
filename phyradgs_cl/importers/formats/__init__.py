"""Importers of scans. Each module reads one or two formats of other programs."""
