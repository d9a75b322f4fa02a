"""Data in and out: demonstrations as LeRobotDataset and HDF5, recorded ones from HDF5, records as tables."""
