"""The program that `trial` starts: in a folder of its own, so that it finds none of this package's modules."""
