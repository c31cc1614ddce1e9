"""The commands, which cli.py lists. Each reads options, calls one function of the library and prints the result."""
