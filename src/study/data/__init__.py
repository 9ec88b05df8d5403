"""Getting and reading data: the only code that touches the network or opens images."""
