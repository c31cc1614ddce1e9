"""One question per file: from a scan, or from fits to it, to a finding."""
