"""One format per file: from another program's scan to ours."""
