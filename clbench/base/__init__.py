"""The ground floor: files, seeds, names and errors. Nothing here imports another part of clbench."""
