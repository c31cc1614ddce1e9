"""Reads HDF5 files of any origin safely: links are followed only within allowed folders, values checked by type and unit."""
