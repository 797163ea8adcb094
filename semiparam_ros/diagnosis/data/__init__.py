"""The samples of a diagnosis: prepared, split, cleared of outliers, and what they can tell."""
