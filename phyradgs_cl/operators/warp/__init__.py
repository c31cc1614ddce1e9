"""Objects that move or deform during a scan: representative states, the warp of a volume to a state, warped projectors."""
