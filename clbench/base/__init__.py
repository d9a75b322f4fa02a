"""The lowest layer: files, seeds, names and errors. Nothing here imports another part of clbench."""
