"""HDF5 files of any origin: opened without harm, read by type and unit."""
