"""What was learnt, in the files that controllers and simulators read."""
