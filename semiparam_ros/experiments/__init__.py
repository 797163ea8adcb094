"""Runs over whole recordings: the comparison of variants, the scoreboard of diagnoses, benchmarks."""
