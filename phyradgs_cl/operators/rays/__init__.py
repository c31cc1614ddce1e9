"""Ray-driven projector (Joseph) with its matched adjoint, of one frame and of whole scans."""
