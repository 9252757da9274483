"""How each algorithm learns: one file, one algorithm, one paper."""
