"""Turns a rough guess of a scene into a MuJoCo simulation that replays a video."""
