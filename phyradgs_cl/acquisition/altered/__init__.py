"""Scans derived from a stated scan: coarser, with corrected or altered geometry and timing, or with summed frames."""
