"""Methods that fit voxels, a file each, around one system of operators."""
