"""Training of the dm_control experts with SAC, behind the command `clbench experts train`."""
