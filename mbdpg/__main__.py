"""`python -m mbdpg` is the command line."""

from mbdpg.cli import main

main()
