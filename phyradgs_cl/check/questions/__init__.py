"""One question a file: from a scan, or from fits to it, to a finding."""
