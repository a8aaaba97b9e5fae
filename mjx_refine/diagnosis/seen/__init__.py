"""What is seen of a clip: measured on masks and flow, and predicted from paths."""
