"""Methods that fit a neural field, on PyTorch."""
