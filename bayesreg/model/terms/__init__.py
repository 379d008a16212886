"""Terms: the factors of the joint density, a file each."""
