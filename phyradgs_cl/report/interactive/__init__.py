"""Makes the parts of a page that its script moves: slices, the volume in 3D, an object in motion, a frame in motion."""
