"""Formats of laboratory scanners, whose sample turns between a source and a panel at rest."""
