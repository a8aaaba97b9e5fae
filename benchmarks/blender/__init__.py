"""Clips made by Blender: its rigid bodies (Bullet), its renderer (Cycles); shapes and motions as in CLEVRER.

Blender runs in an environment of its own (`requirements.txt`), since it wants another NumPy than JAX does. A clip's
folder is small: pictures, masks, poses and truth; `observe` measures the flow wherever the set is used.
"""
