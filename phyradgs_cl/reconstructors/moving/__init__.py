"""Reconstruction of an object that moves in an unknown way: its signal in time, its displacement field, its volume."""
