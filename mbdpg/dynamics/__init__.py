"""The learned world (Section 4.1): what it is, how it is fitted, and how it is imagined in."""
