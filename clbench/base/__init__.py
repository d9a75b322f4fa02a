"""The ground floor: files, seeds, names of things and errors. Nothing here imports another part of clbench."""
