"""Diagnosis of what the model lacks: is anything missing, which cause explains it, and what adding it brings."""
