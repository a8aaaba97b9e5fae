"""Diagnosis of several clips of one set-up: shared objects, effects and camera, separate initial states."""
