"""What a fit leaves: where, of what kind, and on frames that it has not seen."""
