"""Scenes changed by instructions in words; what an instruction does not speak of stays as it is, byte for byte."""
