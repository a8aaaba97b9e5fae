"""The diagnosis' withheld exam: clips with a hidden effect, made by PyBullet and a ray tracer of their own.

Every effect is implemented anew here, so that a diagnosis never meets its own simulator. Needs the `bench` extra.
"""
