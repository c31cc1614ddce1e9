"""Methods that fit Gaussians: their start, one training step, the run around it."""
