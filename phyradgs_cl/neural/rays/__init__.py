"""The rays of a pixel over its exposure, and their integrals."""
