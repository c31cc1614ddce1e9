"""Scans derived from a scan: coarser, with corrected or altered geometry and timing, or with summed frames."""
