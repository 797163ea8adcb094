"""The paper's experiment on any pair of recordings: scenario, runs, figures and findings."""
