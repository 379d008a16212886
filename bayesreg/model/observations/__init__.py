"""What was observed of the organ: one file, or one folder, for each kind of observation."""
