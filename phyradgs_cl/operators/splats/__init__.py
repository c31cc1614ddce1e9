"""Projection of Gaussians to frames ("splats"), their evaluation on voxel grids, and the adjoints."""
