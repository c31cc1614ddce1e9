"""Quick least-squares fits of coarse scans: how well a hypothesis explains the frames, and where the axis is."""
