"""Objects that move or deform during a scan: their states at some times, volumes warped to a state, and projectors."""
