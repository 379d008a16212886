"""What a finished run is used for: transforms, maps, scenes."""
