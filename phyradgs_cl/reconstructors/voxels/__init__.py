"""Methods that fit voxels, one file each, around one system of operators."""
