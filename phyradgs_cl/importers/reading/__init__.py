"""Files of other programs as bytes, numbers and images, bounded."""
