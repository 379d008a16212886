"""The commands of the command line, each from a configuration to a folder of results."""
