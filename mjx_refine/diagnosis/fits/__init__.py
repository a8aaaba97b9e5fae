"""Hypotheses and their least squares: numbers, residuals, derivatives, what contacts may err by."""
