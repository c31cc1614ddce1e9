"""A number of a method chosen from the scan itself: what is asked, and the trials that answer."""
