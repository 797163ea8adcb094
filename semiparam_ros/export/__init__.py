"""Export of what was learnt to the files that controllers and simulators read."""
