"""The verbs of the command line, from a configuration to a folder of results."""
