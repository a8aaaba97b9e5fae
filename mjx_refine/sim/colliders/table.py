"""Which collider of ours serves which pairing."""
COLLIDERS = {}
