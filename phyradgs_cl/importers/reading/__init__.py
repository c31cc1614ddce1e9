"""Reads files of other programs as bytes, numbers and images, within bounds of size and place."""
