"""Function approximators and their scaling; they know neither losses nor environments."""
