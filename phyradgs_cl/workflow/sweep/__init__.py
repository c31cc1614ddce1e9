"""Scans × settings × seeds to one resumable results file, volumes and a table."""
