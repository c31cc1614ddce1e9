"""Scans derived from a stated one: coarser, with another geometry or timing, under another hypothesis."""
