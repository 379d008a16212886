"""Code that uses the results of a finished run: transforms, maps, scenes."""
