"""Gaussians to frames and to voxels, with their adjoints."""
