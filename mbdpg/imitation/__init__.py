"""Learning from success (Section 4.2): where demonstrations come from and how they are kept."""
