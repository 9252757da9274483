"""Run folders in, something to look at out."""
