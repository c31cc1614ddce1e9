"""The commands of the command line, one file each: options in, one call into the library, a result printed."""
