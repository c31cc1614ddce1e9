"""The field: encoding, networks, voxels of a grid."""
