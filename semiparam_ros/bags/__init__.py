"""Recordings: read, repaired, converted, written, and aligned into samples."""
