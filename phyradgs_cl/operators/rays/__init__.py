"""Ray-driven projector of volumes (Joseph's method) with its exact transpose."""
