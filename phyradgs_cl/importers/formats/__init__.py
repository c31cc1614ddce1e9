"""Importers of scans, a module for each format of another program."""
