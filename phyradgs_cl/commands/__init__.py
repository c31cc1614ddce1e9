"""The commands: options in, one call into the library, a result printed. cli.py has the table of them."""
