"""The commands of the command line, a file each: options in, one call into the library, a result printed."""
