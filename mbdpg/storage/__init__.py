"""What a run leaves on disk. NumPy in, NumPy out; nothing read from a run is ever unpickled, evaluated or imported."""
