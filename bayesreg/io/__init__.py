"""Code for files and native libraries: volumes, meshes, data sets, run folders."""
