"""The commands. Each reads options, makes one call into the library and prints a result. cli.py lists them."""
