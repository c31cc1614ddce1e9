"""Twins of the kernels: the same mathematics in float64 NumPy, short and slow, with which tests compare the kernels."""
