"""A format a file: from another program's scan to ours."""
