"""Plain float64 NumPy twins of the kernels: slow, short, and what the tests compare against."""
