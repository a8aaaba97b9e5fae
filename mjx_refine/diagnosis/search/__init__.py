"""Which hypotheses are fitted, and from where."""
