"""What is said of the hypotheses."""
