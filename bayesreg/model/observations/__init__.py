"""The observations of the organ: one file or folder for each kind of observation."""
