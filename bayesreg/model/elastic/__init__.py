"""The priors of the displacements: elastic energy or random loads, rigid motions, barrier and skull."""
